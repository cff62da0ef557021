"""Sample periods of channels, learned from their first intervals, and what is a gap by them."""

from __future__ import annotations

import numpy as np

from sms_online.state import Stage, State
from sms_online.stream import Array, Mask

# First intervals of a channel whose median is its period: four of nine may be disturbed.
PERIOD_INTERVALS = 9
# A channel silent for longer than this, s, has a gap whatever its period; it bounds what is held back for a silent
# channel.
LONGEST_HOLE = 1.0


class PeriodsState(State):
    """What is known of periods.

    known (C,): s, NaN while it is not known. intervals (C, PERIOD_INTERVALS): a channel's first, NaN to come.
    """

    known: Array
    intervals: Array


class Periods(Stage):
    """Sample period of each of C channels.

    gap_limit: longest interval between two samples that is no gap, in periods, at most LONGEST_HOLE.
    """

    def __init__(self, count: int, gap_limit: int) -> None:
        self._gap_limit = gap_limit
        self.state = PeriodsState(np.full(count, np.nan), np.full((count, PERIOD_INTERVALS), np.nan))

    @property
    def known(self) -> Array:
        """(C,) s, NaN where it is not known yet."""
        return self.state.known

    def learn(self, channel: int, intervals: Array) -> None:
        """Take a channel's next intervals, s, until nine are known, or a hole ends those that are."""
        self.state.intervals = self.state.intervals.copy()
        first = self.state.intervals[channel]
        for interval in intervals:
            if not np.isnan(self.state.known[channel]):
                return
            count = np.count_nonzero(~np.isnan(first))
            if interval > LONGEST_HOLE:
                self.decide(channel)
            else:
                first[count] = interval
                if count + 1 == PERIOD_INTERVALS:
                    self.decide(channel)

    def decide(self, channel: int) -> None:
        """Take the period from the intervals so far, where there are any."""
        first = self.state.intervals[channel]
        if not np.isnan(first[0]):
            self.state.known = self.state.known.copy()
            self.state.known[channel] = np.nanmedian(first)

    def is_gap(self, interval: Array, channel: int) -> Mask:
        """Which intervals are gaps. Before the period is known only the absolute limit decides."""
        gap = interval > LONGEST_HOLE
        period = self.state.known[channel]
        return gap if np.isnan(period) else gap | (np.rint(interval / period) > self._gap_limit)
