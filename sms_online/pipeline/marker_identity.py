"""Markers that a motion capture has mistaken for each other are given back their names.

A point is predicted from the poses of base and joints and from where it was last seen beside the straight arm: between
two samples deflections hardly change. Where samples lie nearer to the predictions of other markers than to their own,
they are assigned anew, all at once; what becomes clear thereby is relabelled.
Source: Crouse, IEEE Trans. Aerospace and Electronic Systems 52 (2016) 1679, for the assignment (SciPy's).
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from scipy.optimize import linear_sum_assignment

from sms_online.model.model import Model
from sms_online.model.points import Points
from sms_online.pipeline.sensing import Sensing
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices, Mask

# A sample within this distance of its prediction, m, is its marker's: at 240 Hz 1 m/s moves it by 4 mm. Markers that
# come nearer to each other than this are never relabelled.
NEAR = 0.02
# A sample is another marker's where it is so many times nearer to that one's prediction than to its own.
CLEARLY = 4.0
# A pair that is right for so long, s, and then swapped again is swapped anew.
PAUSE = 0.5


class Swap(State):
    """Two markers that were taken for each other from `begin` to `end`, s, in so many samples."""

    first: str
    second: str
    begin: float
    end: float
    samples: int


class IdentityState(State):
    """What predictions are made of.

    rigid (n,): the last known positions of base and joints, NaN before the first. beside (markers, axes): where each
    marker was last seen beside the straight arm, m. swaps: so far.
    """

    rigid: Array
    beside: Array
    swaps: list[Swap] = msgspec.field(default_factory=list)


class MarkerIdentity(Stage):
    """Relabels points among rows of channels; rows come in order of time."""

    def __init__(self, model: Model, sensing: Sensing, channels: Sequence[str]) -> None:
        self._model, self._sensing = model, sensing
        self._points = Points(model.system, model.chain)
        axes = 2 if model.layout.planar else 3
        names = np.array(self._points.names).reshape(-1, axes)
        seen = [k for k, own in enumerate(names) if set(own) <= set(channels)]
        # Of the markers whose channels are all there, where these are and where the model's are.
        self._columns = np.array([[channels.index(name) for name in names[k]] for k in seen]).reshape(-1, axes)
        self._own = np.array([axes * k + a for k in seen for a in range(axes)], dtype=np.int64)
        self._markers = [str(names[k][0]).rpartition(".")[0] for k in seen]
        self.state = IdentityState(np.full(sensing.n_rigid, np.nan), np.zeros((len(seen), axes)))

    def push(self, t: Array, values: Array) -> Array:
        """Rows (B, C) at t (B,), s, with points under their own names."""
        if not self._markers or not t.size:
            return values
        rigid = _held(self.state.rigid, self._sensing.rigid(values))
        self.state.rigid = rigid[-1]
        points = values[:, self._columns]
        whole: Mask = np.asarray(np.isfinite(points).all(axis=2))
        rows = np.flatnonzero(whole.any(axis=1) & np.isfinite(rigid).all(axis=1))
        if not rows.size:
            return values
        x = np.zeros((rows.size, self._model.layout.n_x))
        x[:, : rigid.shape[1]] = rigid[rows]
        straight = self._points(x)[:, self._own].reshape(rows.size, *self.state.beside.shape)
        beside, out = self.state.beside.copy(), values
        for row, seen, expected in zip(rows.tolist(), points[rows], straight, strict=True):
            visible: Indices = np.flatnonzero(np.isfinite(seen).all(axis=1))
            off = seen[visible] - expected[visible]
            identity: Indices = visible
            if np.abs(off - beside[visible]).max() > NEAR:
                identity = _assigned(seen[visible], expected + beside, visible)
                off = seen[visible] - expected[identity]
            beside[identity] = off
            if (moved := np.flatnonzero(identity != visible)).size:
                out = values.copy() if out is values else out
                out[row, self._columns[visible[moved]]] = np.nan
                out[row, self._columns[identity[moved]]] = seen[visible[moved]]
                self._note(float(t[row]), {tuple(sorted((visible[k], identity[k]))) for k in moved.tolist()})
        self.state.beside = beside
        return out

    def _note(self, t: float, pairs: set[tuple[int, ...]]) -> None:
        """Count a row in which pairs of markers are swapped."""
        for a, b in sorted(pairs):
            first, second = self._markers[a], self._markers[b]
            swaps = self.state.swaps
            same = [k for k, s in enumerate(swaps) if (s.first, s.second) == (first, second) and t - s.end < PAUSE]
            if same:
                last = swaps[same[-1]]
                new = Swap(first, second, last.begin, t, last.samples + 1)
                self.state.swaps = [new if k == same[-1] else s for k, s in enumerate(swaps)]
            else:
                self.state.swaps = [*swaps, Swap(first, second, t, t, 1)]


def _held(before: Array, samples: Array) -> Array:
    """Samples (B, n), NaN replaced by the newest before each."""
    rows = np.concatenate((before[None], samples))
    newest = np.maximum.accumulate(np.where(np.isnan(rows), 0, np.arange(len(rows))[:, None]), axis=0)
    return np.asarray(rows[newest, np.arange(rows.shape[1])][1:])


def _assigned(seen: Array, predicted: Array, labels: Indices) -> Indices:
    """Which marker (K,) each sample (K, axes) with a label (K,) is, of those predicted (M, axes)."""
    distance = np.linalg.norm(seen[:, None] - predicted, axis=2)
    _, nearest = linear_sum_assignment(distance**2)
    own, other = distance[np.arange(len(seen)), labels], distance[np.arange(len(seen)), nearest]
    moved = nearest != labels
    apart = np.linalg.norm(predicted[nearest] - predicted[labels], axis=1)
    clear = (CLEARLY * other < own) & (apart > NEAR)
    return nearest.astype(np.int64) if moved.any() and clear[moved].all() else labels
