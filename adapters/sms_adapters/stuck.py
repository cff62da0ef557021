"""Stuck sensors: a channel that repeats one value more often than its own noise ever would."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sms_adapters.increments import increments
from sms_online.stream import Array

# Chance that a healthy sensor repeats itself so many times in a row, given how often it has repeated itself so far.
FALSE_ALARM = 1e-12
# A channel is judged once so many of its samples are known.
LEARNT = 200
# Fewest repetitions that can be an alarm: a sensor read twice as often as it samples repeats each value once.
LEAST_RUN = 8
# A coarse encoder that turns back rests too, but creeps there by single steps; what stops from a change of more
# than this many of its smallest steps has stopped all at once.
SUDDEN = 3.0


class StuckGuard:
    """Takes the samples of sensors that are stuck, or at the end of their range, out of the rows of one source.

    A real sensor's last digits move, even at rest. A value that comes again and again is thus none, unless that is the
    sensor's way (a coarse encoder at rest): so the share of repetitions in each channel's healthy past sets how many in
    a row are an alarm. The samples of a run are blanked from its second one on, as far as they are still here.
    Limitation: a sensor that has nearly always repeated itself is never called stuck.

    groups: columns of the rows that are sampled together. blanked: (C,) samples taken out so far.
    """

    def __init__(self, groups: Sequence[Sequence[int]]) -> None:
        channels = sum(len(group) for group in groups)
        self.blanked = np.zeros(channels, dtype=np.int64)
        self._groups = [np.array(group) for group in groups]
        self._last = np.full(channels, np.nan)
        self._run = np.zeros(channels, dtype=np.int64)  # how often the last value was repeated
        self._change = np.zeros(channels)  # size of the last change
        self._quantum = np.full(channels, np.inf)  # size of the smallest change
        self._seen = np.zeros(channels, dtype=np.int64)
        self._repeated = np.zeros(channels, dtype=np.int64)

    def blank(self, values: Array, new: int) -> None:
        """Blank, in place, what is stuck in rows (K, C), of which the last `new` are seen for the first time."""
        start = values.shape[0] - new
        for group in self._groups:
            present = ~np.isnan(values[start:, group])
            rows = start + np.flatnonzero(present.any(axis=1))
            if rows.size == 0:
                continue
            whole = np.count_nonzero(present) == rows.size * group.size
            changes = np.abs(increments(values[rows[:, None], group], self._last[None, group]))
            if whole and changes.all():
                # Everything moved all the time, NaN before the first sample included.
                self._quantum[group] = np.fmin(self._quantum[group], np.fmin.reduce(changes, axis=0))
                self._last[group], self._run[group] = values[rows[-1], group], 0
                self._change[group] = changes[-1]
                self._seen[group] += rows.size
                continue
            for column, channel in enumerate(group.tolist()):
                self._blank_channel(channel, values[:, channel], start + np.flatnonzero(present[:, column]))

    def _blank_channel(self, channel: int, column: Array, rows: NDArray[np.intp]) -> None:
        if rows.size == 0:
            return
        samples = column[rows]
        change = np.abs(increments(samples, self._last[channel]))
        same = change == 0.0
        moved = change[change > 0.0]
        self._quantum[channel] = min(self._quantum[channel], moved.min(initial=np.inf))
        # Repetitions up to each sample, since the last change: one of this batch, or the one before it.
        number = np.arange(samples.size)
        changed = np.maximum.accumulate(np.where(same, -1, number))
        run = np.where(changed >= 0, number - changed, number + 1 + self._run[channel])
        size = np.where(changed >= 0, change[changed], self._change[channel])
        limit = self._limit(channel)
        stuck = (run >= limit) & (size > SUDDEN * self._quantum[channel])
        self._last[channel], self._run[channel] = samples[-1], run[-1]
        self._change[channel] = size[-1]
        # What is stuck teaches nothing about the sensor's ways.
        self._seen[channel] += np.count_nonzero(~stuck)
        self._repeated[channel] += np.count_nonzero(same & ~stuck)
        for first in np.flatnonzero(stuck & (run == limit)).tolist():
            earlier = np.flatnonzero(~np.isnan(column[: rows[first]]))[1 - limit :]
            self.blanked[channel] += earlier.size
            column[earlier] = np.nan
            self._seen[channel] -= limit - 1
            self._repeated[channel] -= limit - 1
        self.blanked[channel] += np.count_nonzero(stuck)
        column[rows[stuck]] = np.nan

    def _limit(self, channel: int) -> int:
        """Repetitions in a row that are an alarm."""
        if self._seen[channel] < LEARNT:
            return int(np.iinfo(np.int64).max)
        share = (self._repeated[channel] + 1.0) / (self._seen[channel] + 2.0)
        return max(LEAST_RUN, int(np.ceil(np.log(FALSE_ALARM) / np.log(share))))
