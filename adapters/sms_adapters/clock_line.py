"""The session's time at which a device took its samples, from what its clock says and when the samples arrive.

    arrival = (1 + drift) device + offset + latency + delay,    delay >= 0

The constant latency is stated in the system file; the delay scatters, by milliseconds on a busy bus, but now and then a
sample comes through almost undelayed. So the clock is the line below all pairs that is closest to them: a linear
program, solved by the edge of the lower convex hull over the mean of the device's times. Its error falls with the
number n of samples as delay / n, where a mean would give delay / sqrt(n).
Source: Moon, Skelly, Towsley, Estimation and removal of clock skew from network delay measurements, INFOCOM 1999.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sms_online.stream import Array

# Of each such interval of the device's time only the least delayed sample is kept, s: four a second follow a line well.
BIN = 0.25
# What a line is fitted to, s: within it the rate of a crystal that warms up is constant to 0.1 ppm, and 240 samples/s
# with delays up to 2 ms give the offset to a microsecond.
WINDOW = 30.0
# Intervals before the first line is good enough to give times (a second: 10 µs), and after a jump, when drift is known.
SETTLING = 4
SETTLING_AFTER_JUMP = 2
# No clock worth the name is further off than this; a line through a few late samples could be.
LARGEST_DRIFT = 2e-4
# Device times that run ahead of the line or go back by more than this are a jump, s. Delays are positive, so the first
# cannot be one; and no bus turns the order of samples so far apart.
JUMP = 0.05
# So many samples in a row confirm a jump; fewer are corrupt stamps, and their samples are dropped.
CONFIRMED = 8
# The least delayed sample of an interval is off the line by more than this, s: a step, of the device's clock or of the
# latency. A millisecond is beyond any drift between two lines.
STEP = 1e-3
# So many intervals in a row make a step. Samples cannot be early, so two are enough where the line has to go down. Late
# is what a loaded machine makes them for seconds; until it is a step times follow the old line.
EARLY_INTERVALS, LATE_INTERVALS = 2, 40
# But a sender that paused, and whose clock or count did not go on meanwhile, is late by the same time ever after: by
# more than PAUSE, s, and within SAME, s, over so many intervals. A backlog that is worked off grows less.
PAUSE, SAME, PAUSED_INTERVALS = 0.2, 5e-3, 4


@dataclass
class ClockCounters:
    """jumps: of the device's clock, confirmed. steps: smaller ones, or a changed latency. corrupt: stamps dropped."""

    jumps: int = 0
    steps: int = 0
    corrupt: int = 0


def line_below(x: Array, y: Array) -> tuple[float, float]:
    """Slope and value at x = 0 of the line below the points (n,) with the least sum of distances; x increasing.

    The slope is kept within 1 ± LARGEST_DRIFT. One point gives slope 1.
    """
    hull: list[tuple[float, float]] = []
    for a, b in zip(x.tolist(), y.tolist(), strict=True):  # numbers of Python, for one by one they are faster
        while len(hull) > 1:
            (a_i, b_i), (a_j, b_j) = hull[-2:]
            if (b_j - b_i) * (a - a_i) < (b - b_i) * (a_j - a_i):
                break
            hull.pop()
        hull.append((a, b))
    slope = 1.0
    mean = float(np.mean(x))
    for (a_i, b_i), (a_j, b_j) in pairwise(hull):
        if a_i <= mean <= a_j:
            slope = (b_j - b_i) / (a_j - a_i)
            break
    slope = min(max(slope, 1.0 - LARGEST_DRIFT), 1.0 + LARGEST_DRIFT)
    return slope, float(np.min(y - slope * x))


class DeviceClock:
    """Turns a device's stamps into times of the session clock, causally: a sample waits until its time can be told.

    latency: constant delay between the instant of a sample and its arrival, s, as stated.

    A jump of the device's clock (a restart, a correction) is recognised within CONFIRMED samples, after which times are
    held back until the offset is known again; the drift is kept. Times are a function of the pairs and of how they are
    split over calls, nothing else.
    Limitation: a latency that is not stated and a constant part of the delay are taken for offset.
    """

    def __init__(self, latency: float = 0.0) -> None:
        self.latency = latency
        self.counters = ClockCounters()
        self.last_jump = 0.0
        self._origin: tuple[float, float] | None = None  # first device time and arrival: small numbers to reckon with
        self._slope = 1.0
        self._offset = 0.0
        self._settled = False
        self._ahead_at_first: float = np.nan  # of the two clocks, when the first line was fitted
        self._held = np.empty(0)  # device times that wait for their time
        self._dropped = np.empty(0, dtype=bool)  # of those, which are not to get one
        self._ready = np.empty(0)  # times of samples before a jump, not yet given out
        self._suspects: list[tuple[float, float]] = []  # the last samples held, if they could be beyond a jump
        self._newest = -np.inf  # latest device time
        self._begin(SETTLING)

    @property
    def settled(self) -> bool:
        """Whether times can be told now."""
        return self._settled

    @property
    def drift(self) -> float:
        """How much longer the session's second is counted than the device's, relative."""
        return self._slope - 1.0

    @property
    def gained(self) -> float:
        """By how much the session's clock has run ahead of the device's since the first line was fitted, s."""
        return self._ahead() - self._ahead_at_first

    def push(self, device: Array, arrival: Array) -> Array:
        """Times (K,) of the next K samples in order of arrival, earlier ones held back included; NaN: drop the sample.

        device, arrival: (M,) s, stamp and arrival of the new samples, in order of arrival.
        """
        if device.size == 0:
            return np.empty(0)
        if self._origin is None:
            self._origin = float(device[0]), float(arrival[0])
        d, a = device - self._origin[0], arrival - self._origin[1]
        self._held = np.concatenate((self._held, d))
        self._dropped = np.concatenate((self._dropped, np.zeros(d.size, dtype=bool)))
        if self._suspects or self._suspicious(d, a).any():
            self._sift(d, a)
        else:
            self._take(d, a)
        return self._release()

    def finish(self) -> Array:
        """Times of all samples held back, at the end of a session, however little is known of the line."""
        if self._origin is None:
            return np.empty(0)
        self._discard(self._held.size)
        if self._best is not None and not self._settled:
            self._complete_interval()
            self._settled = True
        return self._release()

    def _suspicious(self, d: Array, a: Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        before = np.maximum.accumulate(np.concatenate(([self._newest], d[:-1])))
        ahead = a - (self._offset + self._slope * d) < -JUMP
        return (d < before - JUMP) | (ahead & (self._bins > 0))

    def _sift(self, d: Array, a: Array) -> None:
        """Sample by sample, where a jump is in the air."""
        for k in range(d.size):
            one = slice(k, k + 1)
            held = self._held.size - d.size + k  # where it is held: a jump takes those before it away
            if self._suspicious(d[one], a[one])[0]:
                near = not self._suspects or abs(a[k] - d[k] - self._suspects[-1][1] + self._suspects[-1][0]) < JUMP
                if not near:
                    self._discard(held)
                self._suspects.append((float(d[k]), float(a[k])))
                if len(self._suspects) == CONFIRMED:
                    self._jump(held)
            else:
                self._discard(held)
                self._take(d[one], a[one])

    def _discard(self, end: int) -> None:
        """The suspects, held just before `end`, were corrupt stamps."""
        self._dropped[end - len(self._suspects) : end] = True
        self.counters.corrupt += len(self._suspects)
        self._suspects = []

    def _jump(self, last: int) -> None:
        """The device's clock has jumped: what is held from before it gets the old line's times, a new line begins."""
        suspects = np.array(self._suspects)
        self._suspects = []
        self.counters.jumps += 1
        offset = float(np.min(suspects[:, 1] - self._slope * suspects[:, 0]))
        self.last_jump = self._offset - offset
        beyond = last + 1 - len(suspects)
        if self._settled:
            self._ready = np.concatenate((self._ready, self._times(beyond)))
        else:
            self._ready = np.concatenate((self._ready, np.full(beyond, np.nan)))
        self._held, self._dropped = self._held[beyond:], self._dropped[beyond:]
        self._newest = -np.inf
        self._begin(SETTLING_AFTER_JUMP)
        self._offset = offset
        self._take(suspects[:, 0], suspects[:, 1])

    def _begin(self, settling: int) -> None:
        """Forget the line's points; times are told after so many intervals."""
        self._points: deque[tuple[float, float]] = deque()
        self._best: tuple[float, float] | None = None  # of the current interval
        self._end = -np.inf  # of the current interval
        self._bins = 0
        self._settling = settling
        self._settled = False
        self._off: list[tuple[float, float]] = []  # points in a row that are far off the line

    def _take(self, d: Array, a: Array) -> None:
        """Learn from samples beyond suspicion."""
        self._newest = max(self._newest, float(d.max()))
        delay = a - self._slope * d
        start = 0
        while start < d.size:
            if self._best is None:
                self._end = float(d[start]) + BIN
            later = np.flatnonzero(d[start:] >= self._end)
            stop = start + int(later[0]) if later.size else d.size
            if stop > start:
                k = start + int(np.argmin(delay[start:stop]))
                if self._best is None or delay[k] < self._best[1] - self._slope * self._best[0]:
                    self._best = float(d[k]), float(a[k])
            if stop < d.size:
                self._complete_interval()
                delay = a - self._slope * d
            start = stop

    def _complete_interval(self) -> None:
        assert self._best is not None
        point, self._best = self._best, None
        self._bins += 1
        off = point[1] - self._line(point[0]) if self._settled else 0.0
        if abs(off) > STEP:
            if self._off and (off > 0.0) != (self._off[-1][1] > self._line(self._off[-1][0])):
                self._off = []
            self._off.append(point)
            if not self._is_step(off):
                return
            self.counters.steps += 1
            # The first of them may lie between the old line and the new.
            self._points = deque(self._off[-max(len(self._off) // 2, 1) :])
        else:
            self._points.append(point)
        self._off = []
        while self._points[-1][0] - self._points[0][0] > WINDOW:
            self._points.popleft()
        self._fit()

    def _is_step(self, off: float) -> bool:
        """Whether the points off the line, the last of them by `off`, are enough for a step."""
        if off < 0.0:
            return len(self._off) >= EARLY_INTERVALS
        last = [a - self._line(d) for d, a in self._off[-PAUSED_INTERVALS:]]
        paused = len(last) == PAUSED_INTERVALS and min(last) > PAUSE and max(last) - min(last) < SAME
        return paused or len(self._off) >= LATE_INTERVALS

    def _ahead(self) -> float:
        return self._offset + (self._slope - 1.0) * self._newest

    def _line(self, d: float) -> float:
        return self._offset + self._slope * d

    def _fit(self) -> None:
        points = np.array(self._points)
        order = np.argsort(points[:, 0], kind="stable")
        x, y = points[order].T
        if x.size >= SETTLING:
            self._slope, self._offset = line_below(x, y)
        else:
            self._offset = float(np.min(y - self._slope * x))
        self._settled = self._bins >= self._settling
        if self._settled and np.isnan(self._ahead_at_first):
            self._ahead_at_first = self._ahead()

    def _times(self, count: int) -> Array:
        """Times of the first `count` samples held."""
        assert self._origin is not None
        t = self._origin[1] + self._offset + self._slope * self._held[:count] - self.latency
        return np.where(self._dropped[:count], np.nan, t)

    def _release(self) -> Array:
        count = self._held.size - len(self._suspects) if self._settled else 0
        out = np.concatenate((self._ready, self._times(count)))
        self._ready = np.empty(0)
        self._held, self._dropped = self._held[count:], self._dropped[count:]
        return out
