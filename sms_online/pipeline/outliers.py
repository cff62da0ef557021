"""Single samples that cannot be the motion's are left out: a mislabelled marker, a bit that flipped.

A sample is predicted by the cubic through two samples of its channel on either side. It is an outlier when it is off by
many times what the channel's samples are off by, and its neighbours agree with each other without it: at a shock or a
step they do not. The largest one goes first, so that outliers next to each other are found one after the other.

Reading: Hampel's identifier, with a local cubic in place of the local median (Davies and Gather, J. American
Statistical Association 88 (1993) 782).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sms_online.grouping import sampled_together
from sms_online.pipeline.noise import NORMAL_MAD
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices

# A sample off by so many robust deviations is an outlier: of white noise one sample in 10⁸ is.
OUTLIER = 6.0
# And by so many steps of a channel that is quantised: one forth and back is none.
STEPS = 3.0
# And by so many times what its neighbours are off by from each other without outliers.
ALONE = 4.0
# Samples of its channel on either side that predict a sample.
SIDE = 2
# Outliers next to each other that are distinguished.
PASSES = 4
# Rows wait no longer than this for samples that a channel still owes, s. Channels that are too slow for that are not
# judged: their neighbours do not predict them either.
PATIENCE = 0.1
# Deviations of a channel follow its samples with this memory, in samples; before there are so many, none is judged.
MEMORY, FEWEST = 400.0, 20


class LeftOut(NamedTuple):
    """Samples of a channel that were left out: their number, of how many, and the time of the first, s."""

    number: int
    of: int
    first: float


class OutlierState(State):
    """What is kept of the samples.

    time (B,), values (B, C): rows that predict later ones, then those that wait. passed: how many of them are passed
    on. deviation (C,): robust 1σ of what samples are off by, and weight (C,): number of samples behind it. step (C,):
    smallest change from sample to sample. left_out, judged (C,): how many samples so far. first (C,): time of the
    first that was left out, s.
    """

    time: Array
    values: Array
    passed: int
    deviation: Array
    weight: Array
    step: Array
    left_out: Indices
    judged: Indices
    first: Array


class Outliers(Stage):
    """Leaves outliers of some channels out of rows, which it passes on a little later.

    channels: number of all. columns: those of sensors, whose samples are judged.
    """

    def __init__(self, channels: int, columns: Sequence[int]) -> None:
        self._columns: Indices = np.array(columns, dtype=np.int64)
        none = np.zeros(channels, dtype=np.int64)
        empty, unknown = np.empty((0, channels)), np.zeros(channels)
        never = np.full(channels, np.inf)
        self.state = OutlierState(empty[:, 0], empty, 0, unknown, unknown, never, none, none, never)

    def found(self, channels: Sequence[str]) -> dict[str, LeftOut]:
        """What was left out so far, of each channel with any. channels: names of all."""
        now = self.state
        counts = zip(now.left_out.tolist(), now.judged.tolist(), now.first.tolist(), strict=True)
        return {name: LeftOut(*found) for name, found in zip(channels, counts, strict=True) if found[0]}

    def push(self, t: Array, values: Array, last: bool = False) -> tuple[Array, Array]:
        """Take rows (B, C) at times t (B,), NaN where a channel has no sample, and return those judged by now.

        last: no more will come; all rows are returned.
        """
        now = self.state
        time, kept = np.concatenate((now.time, t)), np.concatenate((now.values, values))
        if not time.size:
            return time, kept
        groups = self._sampled_together(kept)
        end = time.size if last else self._judged_up_to(time, groups)
        end = max(end, now.passed)
        for columns, rows in groups:
            self._judge(time, kept, columns, rows, end)
        out = time[now.passed : end], kept[now.passed : end]
        # Samples before the ones that wait, which predict them.
        needed = min((int(rows[max(0, int(np.searchsorted(rows, end)) - 2 * SIDE)]) for _, rows in groups), default=end)
        needed = max(min(needed, end), int(np.searchsorted(time, time[-1] - 2.0 * PATIENCE)))
        now.time, now.values, now.passed = time[needed:], kept[needed:], max(0, end - needed)
        return out

    def _sampled_together(self, values: Array) -> list[tuple[Indices, Indices]]:
        """Sensors' columns with samples in the same rows, and these rows."""
        groups = sampled_together(values[:, self._columns], ("",) * self._columns.size)
        return [(self._columns[own], rows) for own, rows in groups if rows.size]

    def _judged_up_to(self, time: Array, groups: Sequence[tuple[Indices, Indices]]) -> int:
        """Rows whose samples are followed by as many as it takes, or have waited long enough."""
        waiting = [int(rows[-SIDE]) for _, rows in groups if rows.size >= SIDE]
        return max(min(waiting, default=time.size), int(np.searchsorted(time, time[-1] - PATIENCE)))

    def _judge(self, time: Array, values: Array, columns: Indices, rows: Indices, end: int) -> None:
        """Write NaN over the outliers of some columns, with samples in some rows, up to row `end`."""
        now = self.state
        own = slice(int(np.searchsorted(rows, now.passed)), int(np.searchsorted(rows, end)))
        count = own.stop - own.start
        if rows.size < 2 * SIDE + 1 or count == 0:
            return
        samples, t = values[np.ix_(rows, columns)], time[rows]
        if np.median(np.diff(t)) > PATIENCE / SIDE:
            return
        off = _off(t, samples)
        median = np.median(np.abs(off[own]), axis=0) / NORMAL_MAD
        memory = now.weight[columns] + count
        share = count / np.minimum(memory, MEMORY + count)
        now.deviation, now.weight = now.deviation.copy(), now.weight.copy()
        now.deviation[columns] += share * (median - now.deviation[columns])
        now.weight[columns] = memory
        change = np.abs(np.diff(samples, axis=0))
        now.step = now.step.copy()
        now.step[columns] = np.minimum(now.step[columns], np.where(change > 0.0, change, np.inf).min(axis=0))
        least = np.maximum(OUTLIER * now.deviation[columns], STEPS * now.step[columns])
        least[memory < FEWEST] = np.inf
        now.left_out, now.judged, now.first = now.left_out.copy(), now.judged.copy(), now.first.copy()
        now.judged[columns] += count
        for k in np.flatnonzero((np.abs(off[own]) > least).any(axis=0)).tolist():
            found = _outliers(t, samples[:, k], float(least[k]), own)
            values[rows[found], columns[k]] = np.nan
            now.left_out[columns[k]] += found.size
            now.first[columns[k]] = t[found].min(initial=now.first[columns[k]])


def _off(t: Array, samples: Array) -> Array:
    """What samples (B, C) at times t (B,) are off by from the cubic through their neighbours; 0 at the borders.

    In units of the sample's own noise: divided by what unit white noise makes of it.
    """
    out = np.zeros_like(samples)
    middle = np.arange(SIDE, t.size - SIDE)
    nodes = middle[:, None] + np.array([-2, -1, 1, 2])
    x = t[nodes] - t[middle][:, None]
    apart = x[:, :, None] - x[:, None, :]
    # Not the synchroniser's weights: samples that came twice are still among these.
    ratio = -x[:, None, :] / np.where(apart == 0.0, 1.0, apart)
    own = np.arange(nodes.shape[1])
    ratio[:, own, own] = 1.0
    weight = np.prod(ratio, axis=2)
    predicted = np.einsum("kn,knc->kc", weight, samples[nodes])
    out[middle] = (samples[middle] - predicted) / np.sqrt(1.0 + np.sum(weight**2, axis=1))[:, None]
    return out


def _outliers(t: Array, samples: Array, least: float, own: slice) -> Indices:
    """Places of the outliers among samples (B,) at times t (B,) of one channel, of those in `own`.

    least: by which they are off.
    """
    kept = np.arange(t.size)
    found: dict[int, float] = {}  # by how much they were off
    for _ in range(PASSES):
        off = np.abs(_off(t[kept], samples[kept, None])[:, 0])
        inside = (kept >= own.start) & (kept < own.stop)
        # Of neighbours that are off the largest is the outlier, the others are off because of it.
        around = np.lib.stride_tricks.sliding_window_view(np.pad(off, SIDE), 2 * SIDE + 1).max(axis=1)
        gone = np.flatnonzero(inside & (off > least) & (off == around))
        found |= zip(kept[gone].tolist(), off[gone].tolist(), strict=True)
        kept = np.delete(kept, gone)
        if not gone.size:
            break
    while True:
        kept = np.delete(np.arange(t.size), list(found))
        left = np.abs(_off(t[kept], samples[kept, None])[:, 0])
        places = np.searchsorted(kept, np.array(list(found), dtype=np.int64))
        beside = [left[max(0, place - 2 * SIDE) : place + 2 * SIDE].max(initial=0.0) for place in places.tolist()]
        alone = {k: off for (k, off), other in zip(found.items(), beside, strict=True) if off > ALONE * other}
        if len(alone) == len(found):
            return np.array(sorted(found), dtype=np.int64)
        found = alone
