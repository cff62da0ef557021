"""Device times of samples whose device sends none, by the count of its frames."""

from __future__ import annotations

import numpy as np

from sms_online.stream import Array, Indices, increments

# Samples that come further apart than this, s, have a hole between them whatever the delays of a bus.
HOLE = 0.1


class CountedTime:
    """A sender that counts its frames and sends them periodically: count times period is its time.

    modulus: at which the count starts again from 0; whole rounds lost are counted by the arrivals. period: nominal, s;
    what it is off by shows up as drift of the clock.
    """

    def __init__(self, modulus: int, period: float) -> None:
        self._modulus = modulus
        self._period = period
        self._last: tuple[int, float] | None = None  # count and arrival of the last frame
        self._whole = 0  # its count with the rounds in it

    def __call__(self, counts: Indices, arrival: Array) -> Array:
        """Device times (M,), s, of frames with these counts (M,), in order of arrival (M,)."""
        if counts.size == 0:
            return np.empty(0)
        count, before = (int(counts[0]), float(arrival[0])) if self._last is None else self._last
        half = self._modulus // 2
        # Steps back are frames that overtook each other, so a step is the smaller way round.
        step = (increments(counts, count) + half) % self._modulus - half
        elapsed = increments(arrival, before) / self._period
        step += self._modulus * np.rint((elapsed - step) / self._modulus).astype(np.int64)
        whole = self._whole + np.cumsum(step)
        self._whole, self._last = int(whole[-1]), (int(counts[-1]), float(arrival[-1]))
        return np.asarray(whole * self._period)


class NumberedTime:
    """Samples without any mark of their time: their number times the nominal period, s.

    Limitation: a lost sample shifts all later ones by a period, until the clock takes it for a step, a second later; a
    hole longer than HOLE is counted at once.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._number = -1
        self._arrival = np.nan

    def __call__(self, arrival: Array) -> Array:
        """Device times (M,), s, of samples that arrived at (M,), s."""
        if arrival.size == 0:
            return np.empty(0)
        gap = np.diff(arrival, prepend=arrival[0] if np.isnan(self._arrival) else self._arrival)
        step = np.where(gap > HOLE, np.maximum(np.rint(gap / self._period), 1.0), 1.0).astype(np.int64)
        number = self._number + np.cumsum(step)
        self._number, self._arrival = int(number[-1]), float(arrival[-1])
        return np.asarray(number * self._period)
