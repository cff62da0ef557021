"""The clock of a motion capture beside that of the drives' recording, from the motion that both have measured.

Encoders say where the markers of the undeformed arm are. That course is found again in what the cameras saw by its
correlation at every shift. Then the difference of both, whitened for the shapes that links usually take, gives offset
and rate of the clock by least squares, beside the places of the markers.
Source: Padfield, IEEE Transactions on Image Processing 21 (2012) 2706 (correlation of samples with gaps).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import correlate

from sms_online.model.model import Model
from sms_online.model.points import Points
from sms_online.pipeline.sensing import USUAL_NOISE, Sensing, stated_noise
from sms_online.stream import Array, Block, Mask

# Rate at which shifts are tried, Hz: motions of arms are slower by far.
COARSE = 100.0
# Share of the shorter recording that both have in common, at least.
OVERLAP = 0.5
# Another shift does as well where it leaves less than so many times as much; by how far it is another, s.
AS_WELL, APART = 2.0, 0.2
# Half the time over which rates are taken, s, and instants that the arm is fitted at.
SPAN, MOST_INSTANTS = 0.02, 3000
# Passes of the fit, blocks of the jackknife, and deviations beyond which an instant is an outlier or a rate is one.
PASSES, BLOCKS, OUTLIER, SIGNIFICANT = 8, 10, 5.0, 3.0
# What markers are off their described places by, and what one that is not seen may be off by, m.
PLACED, UNSEEN = 0.005, 10.0


@dataclass(frozen=True)
class CameraClock:
    """The drives' time at the cameras' t = 0, s, and what the drives' clock gains on the cameras', s/s.

    offset_std, rate_std: their deviations.
    """

    offset: float
    offset_std: float
    rate: float
    rate_std: float

    def of_drives(self, t: Array) -> Array:
        """Instants of the cameras' clock as those of the drives'."""
        return self.offset + (1.0 + self.rate) * t


@dataclass(frozen=True)
class Shift:
    """A shift between two recordings of a motion, s, and the share of the variance that it does not explain.

    other: another that explains the motion as well, None where there is none.
    """

    shift: float
    left: float
    other: float | None


def shift_between(t_seen: Array, seen: Array, t: Array, expected: Array) -> Shift:
    """The shift that explains seen (B, C) at t_seen (B,), NaN where it is not, by expected (N, C) at t (N,).

    What each channel is off by throughout does not count.
    """
    a, b = _on_grid(t, expected), _on_grid(t_seen, seen)

    def along(x: Array, y: Array) -> Array:
        return np.stack([correlate(x[:, c], y[:, c], method="fft") for c in range(x.shape[1])])

    known_a, known_b = (np.isfinite(part).astype(float) for part in (a, b))
    knowns = (a, known_a), (b, known_b)
    # Far from zero the sums of squares would be differences of large numbers.
    a, b = (np.nan_to_num(part - np.nansum(part, axis=0) / known.sum(axis=0).clip(1)) for part, known in knowns)
    count = np.maximum(along(known_a, known_b), 1e-9)
    sum_a, sum_b = along(a, known_b), along(known_a, b)
    cross = (along(a, b) - sum_a * sum_b / count).sum(axis=0)
    squares = [along(a**2, known_b) - sum_a**2 / count, along(known_a, b**2) - sum_b**2 / count]
    size = np.sqrt(np.prod([np.maximum(each.sum(axis=0), 0.0) for each in squares], axis=0))
    counts = count.sum(axis=0)
    enough = (counts >= OVERLAP * min(known_a.sum(), known_b.sum())) & (size > 1e-6 * size.max())
    r = np.divide(cross, size, out=np.zeros_like(cross), where=enough)
    shifts = (np.arange(r.size) - (len(b) - 1)) / COARSE + t[0] - t_seen[0]
    left = np.where(r > 0.0, 1.0 - r**2, 1.0)
    best = int(np.argmin(left))
    others = np.flatnonzero((np.abs(shifts - shifts[best]) > APART) & (left < AS_WELL * left[best]))
    other = float(shifts[others[np.argmin(left[others])]]) if others.size else None
    return Shift(float(shifts[best]), float(left[best]), other)


def _on_grid(t: Array, values: Array) -> Array:
    """Values (G, C) at the coarse rate from the first instant on, NaN where no sample is near."""
    grid = t[0] + np.arange(int((t[-1] - t[0]) * COARSE) + 1) / COARSE
    near = np.clip(np.searchsorted(t, grid), 1, t.size - 1)
    near -= grid - t[near - 1] < t[near] - grid
    out = values[near]
    out[np.abs(t[near] - grid) > 1.0 / COARSE] = np.nan
    return np.asarray(out)


class ClockFit:
    """Least squares of what the cameras see over offset and rate of their clock, and the places of the markers."""

    def __init__(self, model: Model, sensing: Sensing, seen: Block, recorded: Block) -> None:
        """seen: by the cameras, on their clock. recorded: the other channels of sensing, on the drives'."""
        self._layout, self._sensing, self._points = model.layout, sensing, Points(model.system, model.chain)
        steps = max(1, seen.t.size // MOST_INSTANTS)
        self._t = seen.t[::steps]
        self._seen = {name: seen.values[::steps, k] for k, name in enumerate(seen.channels)}
        unseen = np.full(self._t.size, np.nan)
        self._measured = np.stack([self._seen.get(name, unseen) for name in self._points.names], axis=1)
        stated = stated_noise(model.system, self._points.names)
        self._noise = np.where(stated > 0.0, stated, USUAL_NOISE)
        self._recorded = {}
        for name, own in zip(recorded.channels, recorded.values.T, strict=True):
            known = np.isfinite(own)
            self._recorded[name] = recorded.t[known], own[known]
        self._middle = 0.5 * (self._t[0] + self._t[-1])
        # Either clock may have begun long before the other.
        self._first, self._last = recorded.t[0] + SPAN, recorded.t[-1] - SPAN

    def clock(self, shift: float) -> CameraClock:
        """The clock near a shift, s."""
        at, rated = np.array([shift + self._middle, 0.0]), True  # the drives' time in the middle, and the rate
        for k in range(PASSES):
            white, b = self._white(at)
            step, covariance = _solved(white, b, rated)
            at[: step.size] += step
            if k == PASSES // 2 and abs(at[1]) < SIGNIFICANT * covariance[1, 1] ** 0.5:
                # A rate that is none would only widen the bar of the offset.
                at[1], rated = 0.0, False
        at_zero = np.array([1.0, -self._middle])
        offset_std, rate_std = float(np.sqrt(at_zero @ covariance @ at_zero)), float(np.sqrt(covariance[1, 1]))
        return CameraClock(float(at[0] - (1.0 + at[1]) * self._middle), offset_std, float(at[1]), rate_std)

    def _values(self, instants: Array, seen: Mask) -> Array:
        """Samples (B, channels) of sensing, those of the recording at instants (B,) of the drives' clock."""
        columns = [
            self._seen[name][seen] if name in self._seen else np.interp(instants, *self._recorded[name])
            for name in self._sensing.channels
        ]
        return np.stack(columns, axis=1)

    def _white(self, at: Array) -> tuple[Array, Array]:
        """Whitened columns (B, C, 2 + places) and differences (B, C) about middle and rate (2,)."""
        instants = at[0] + (1.0 + at[1]) * (self._t - self._middle)
        inside = (instants > self._first) & (instants < self._last)
        t, instants, sensing, layout = self._t[inside], instants[inside], self._sensing, self._layout
        x = sensing.coordinates(self._values(instants, inside))
        whole = np.isfinite(x).all(axis=1)
        t, instants, x = t[whole], instants[whole], x[whole]
        inside[inside] = whole
        moved = np.zeros_like(x)
        rigid = [sensing.rigid(self._values(instants + shift, inside)) for shift in (-SPAN, SPAN)]
        moved[:, : sensing.n_rigid] = (rigid[1] - rigid[0]) / (2.0 * SPAN)
        J = self._points.by_displacement(x)
        shapes = sensing.usual_shapes
        elastic = np.concatenate([np.arange(layout.q_f[i].start, layout.q_f[i].stop) for i in shapes])
        D, q_f = J[:, :, elastic], x[:, elastic + layout.offset]
        seen = self._measured[inside]
        missed = seen - self._points(x) + (D @ q_f[..., None])[..., 0]
        along = (J @ layout.speeds(x, moved)[..., None])[..., 0]
        unseen = np.isnan(missed)
        missed[unseen] = along[unseen] = 0.0
        variance = np.where(unseen, UNSEEN**2, self._noise**2)
        covariance = D @ block_diag(*shapes.values()) @ D.swapaxes(1, 2)
        covariance[:, range(D.shape[1]), range(D.shape[1])] += variance
        root = np.linalg.cholesky(covariance)
        columns = np.concatenate((along[..., None], (along * (t - self._middle)[:, None])[..., None]), axis=2)
        columns = np.concatenate((columns, self._points.by_place(x)), axis=2)
        return np.linalg.solve(root, columns), np.linalg.solve(root, missed[..., None])[..., 0]


def _solved(columns: Array, b: Array, rated: bool) -> tuple[Array, Array]:
    """Change of middle and rate, one or both, and its covariance (2, 2) from the jackknife over blocks of time."""
    if not rated:
        columns = np.delete(columns, 1, axis=2)
    n, clocks = columns.shape[2], 1 + rated
    places = np.zeros((n - clocks, n))
    places[:, clocks:] = np.eye(n - clocks) / PLACED

    def least_squares(used: Mask) -> Array:
        rows = np.concatenate((columns[used].reshape(-1, n), places))
        return np.linalg.lstsq(rows, np.append(b[used].ravel(), np.zeros(n - clocks)), rcond=None)[0]  # type: ignore[no-any-return]

    used = np.ones(len(b), dtype=bool)
    left = np.linalg.norm(b - columns @ least_squares(used), axis=1)
    used = left < OUTLIER * np.median(left)
    block = np.arange(len(b)) * BLOCKS // len(b)
    parts = np.zeros((BLOCKS, 2))
    for k in range(BLOCKS):
        parts[k, :clocks] = least_squares(used & (block != k))[:clocks]
    parts -= parts.mean(axis=0)
    return least_squares(used)[:clocks], (BLOCKS - 1) / BLOCKS * parts.T @ parts
