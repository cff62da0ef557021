"""When a device took its samples, in the session's time, by its own clock and the samples' arrivals.

    arrival = (1 + drift) device + offset + latency + delay,    delay >= 0

The constant latency is stated in the system file; the delay scatters, by milliseconds on a busy bus, but now and then a
sample comes through almost undelayed. So the clock is a line below all pairs and close to them. With delays whose
density falls exponentially the likeliest one is that with the least sum of distances, an edge of the lower convex hull,
whose error falls with the number n of samples as delay / n, where a mean would give delay / sqrt(n). But while points
are few the edge leans on two of them, one of which may be early by luck, and its slope throws the times between two
lines: the mean over all lines by their likelihood, and by what crystals drift, errs half as much in the first seconds.
Sources: Moon, Skelly, Towsley, Estimation and removal of clock skew from network delay measurements, INFOCOM 1999 (the
line below); Bayes, with a flat density of offsets and a normal one of drifts.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from statistics import median

import numpy as np

from sms_online.stream import Array

# Of each such interval of the device's time only the least delayed sample is kept, s: four a second follow a line well.
BIN = 0.25
# What a line is fitted to, s: within it the rate of a crystal that warms up is constant to 0.1 ppm, and 240 samples/s
# with delays up to 2 ms give the offset to a microsecond.
WINDOW = 30.0
# Intervals before the first line is good enough to give times (a second: 10 µs), and after a jump, when drift is known.
FIRST_INTERVALS = 4
FIRST_AFTER_JUMP = 2
# No clock worth the name is further off than this; a line through a few late samples could be.
LARGEST_DRIFT = 2e-4
# What two crystals of 20 ppm are off by against each other, 1σ.
CRYSTALS = 3e-5
# Neighbouring intervals are late together, for the machine is busy in both: each counts as so much of an own one.
INDEPENDENT = 0.5
# Drifts that the mean is taken over: enough of them, as likely as e^-LEAST_LIKELY of the likeliest one at least.
DRIFTS, ENOUGH, LEAST_LIKELY = 101, 25, 18.0
# Delays are not resolved finer than this, s: clocks of the machine are read to it.
FINEST_DELAY = 1e-7
# Device times that run ahead of the line or go back by more than this are a jump, s. Delays are positive, so the first
# cannot be one; and no bus turns the order of samples so far apart.
JUMP = 0.05
# So many samples in a row confirm a jump; fewer are corrupt stamps, and their samples are dropped.
CONFIRMED = 8
# The least delayed sample of an interval is off the line by more than this, s: a step, of the device's clock or of the
# latency. A millisecond is beyond any drift between two lines.
STEP = 1e-3
# So many intervals in a row make a step. Samples cannot be early, so two are enough where the line has to go down. Late
# is what a loaded machine makes them for as long as it is loaded, but then by ever other delays. Behind a step half of
# the intervals are late by the same, within SAME, s, and a tenth of the step; until then times follow the old line.
EARLY_INTERVALS, LATE_INTERVALS, SAME = 2, 40, 5e-3
# But a sender that paused, and whose clock or count did not go on meanwhile, is late by the same time ever after: by
# more than PAUSE, s, over so many intervals. A backlog that is read grows less.
PAUSE, PAUSED_INTERVALS = 0.2, 4


@dataclass
class ClockCounters:
    """What happened to a device's clock.

    jumps: confirmed ones. steps: smaller ones, or a changed latency. corrupt: stamps dropped.
    """

    jumps: int = 0
    steps: int = 0
    corrupt: int = 0


def likely_line(x: Array, y: Array) -> tuple[float, float]:
    """Slope, and value at x = 0, of the mean line below points.

    x, y (n,): x increasing. The slope is within 1 ± LARGEST_DRIFT. For a drift g the line touches the lowest point, y -
    x - g x = m(g); with delays of the mean s its likelihood is exp(-Σ (y - x - g x - m) / s), a concave function of g
    in the exponent. One point gives slope 1.
    """
    # About the last point, for clocks may be decades apart.
    since_last = x - x[-1]
    ahead = (y - y[-1]) - since_last

    def distances(drift: Array) -> tuple[Array, Array]:
        """Of each point from the line (drifts, n), and the lines' values at the last point."""
        left = ahead - drift[:, None] * since_last
        lowest = left.min(axis=1)
        return left - lowest[:, None], lowest

    low, high = -LARGEST_DRIFT, LARGEST_DRIFT
    delay = np.inf
    while True:
        drift = np.linspace(low, high, DRIFTS)
        distance, lowest = distances(drift)
        total = distance.sum(axis=1)
        # The median of an exponential density, which no stall moves, of the line with the least sum of distances.
        closest = distance[np.argmin(total)]
        delay = max(min(delay, float(np.median(closest)) / np.log(2.0)), FINEST_DELAY)
        log_likelihood = -INDEPENDENT * total / delay - 0.5 * (drift / CRYSTALS) ** 2
        likely = np.flatnonzero(log_likelihood > log_likelihood.max() - LEAST_LIKELY)
        before = high - low
        low, high = float(drift[max(likely[0] - 1, 0)]), float(drift[min(likely[-1] + 1, DRIFTS - 1)])
        if likely.size >= ENOUGH or high - low >= before:
            break
    weight = np.exp(log_likelihood - log_likelihood.max())
    weight /= weight.sum()
    mean, value = float(weight @ drift), float(weight @ lowest)
    return 1.0 + mean, value + float(y[-1] - (1.0 + mean) * x[-1])


class DeviceClock:
    """Turns a device's stamps into times of the session's clock. A sample waits until its time is known.

    latency: constant delay between the instant of a sample and its arrival, s, as stated.

    A jump of the device's clock (a restart, a correction) is recognised within CONFIRMED samples, after which times are
    held back until the offset is known again; the drift is kept until then. Times are a function of the pairs and of
    how they are split over calls, nothing else.
    Limitation: a latency that is not stated and a constant part of the delay are taken for offset.
    """

    def __init__(self, latency: float = 0.0) -> None:
        self.latency = latency
        self.counters = ClockCounters()
        self.last_jump = 0.0
        self._origin: tuple[float, float] | None = None  # first device time and arrival: small numbers to reckon with
        self._slope = 1.0
        self._offset = 0.0
        self._known = False
        self._ahead_at_first: float = np.nan  # of the two clocks, when the first line was fitted
        self._held = np.empty(0)  # device times that wait for their time
        self._dropped = np.empty(0, dtype=bool)  # of those, which are not to get one
        self._ready = np.empty(0)  # times of samples before a jump, not yet given out
        self._suspects: list[tuple[float, float]] = []  # the last samples held, if they could be beyond a jump
        self._newest = -np.inf  # latest device time
        self._begin(FIRST_INTERVALS)

    @property
    def known(self) -> bool:
        """Whether the line is known well enough to give times."""
        return self._known

    @property
    def drift(self) -> float:
        """How much longer the session's second is counted than the device's, relative."""
        return self._slope - 1.0

    @property
    def gained(self) -> float:
        """By how much the session's clock has run ahead of the device's since the first line was fitted, s."""
        return self._ahead() - self._ahead_at_first

    def push(self, device: Array, arrival: Array) -> Array:
        """Times (K,) of the next samples in order of arrival, those held back before included.

        NaN: drop the sample. device, arrival: (M,) s, stamp and arrival of the new samples, in order of arrival.
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
        if self._best is not None and not self._known:
            self._complete_interval()
            self._known = True
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
        if self._known:
            self._ready = np.concatenate((self._ready, self._times(beyond)))
        else:
            self._ready = np.concatenate((self._ready, np.full(beyond, np.nan)))
        self._held, self._dropped = self._held[beyond:], self._dropped[beyond:]
        self._newest = -np.inf
        self._begin(FIRST_AFTER_JUMP)
        self._offset = offset
        self._take(suspects[:, 0], suspects[:, 1])

    def _begin(self, first: int) -> None:
        """Forget the line's points; times are given after so many intervals."""
        self._points: deque[tuple[float, float]] = deque()
        self._best: tuple[float, float] | None = None  # of the current interval
        self._end = -np.inf  # of the current interval
        self._bins = 0
        self._first = first
        self._known = False
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
        off = point[1] - self._line(point[0]) if self._known else 0.0
        if abs(off) > STEP:
            if self._off and (off > 0.0) != (self._off[-1][1] > self._line(self._off[-1][0])):
                self._off = []
            self._off.append(point)
            if not self._is_step(off):
                return
            self.counters.steps += 1
            # The first of them may lie between the old line and the new.
            self._points = deque(self._off[-max(min(len(self._off), LATE_INTERVALS) // 2, 1) :])
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
        late = [a - self._line(d) for d, a in self._off[-LATE_INTERVALS:]]
        last = late[-PAUSED_INTERVALS:]
        paused = len(last) == PAUSED_INTERVALS and min(last) > PAUSE and max(last) - min(last) < SAME
        least = min(late)
        return paused or (len(late) == LATE_INTERVALS and median(late) - least < min(SAME, 0.1 * least))

    def _ahead(self) -> float:
        return self._offset + (self._slope - 1.0) * self._newest

    def _line(self, d: float) -> float:
        return self._offset + self._slope * d

    def _fit(self) -> None:
        points = np.array(self._points)
        order = np.argsort(points[:, 0], kind="stable")
        x, y = points[order].T
        if x.size >= FIRST_INTERVALS:
            self._slope, self._offset = likely_line(x, y)
        else:
            self._offset = float(np.min(y - self._slope * x))
        self._known = self._bins >= self._first
        if self._known and np.isnan(self._ahead_at_first):
            self._ahead_at_first = self._ahead()

    def _times(self, count: int) -> Array:
        """Times of the first `count` samples held."""
        assert self._origin is not None
        t = self._origin[1] + self._offset + self._slope * self._held[:count] - self.latency
        return np.where(self._dropped[:count], np.nan, t)

    def _release(self) -> Array:
        count = self._held.size - len(self._suspects) if self._known else 0
        out = np.concatenate((self._ready, self._times(count)))
        self._ready = np.empty(0)
        self._held, self._dropped = self._held[count:], self._dropped[count:]
        return out
