"""One channel of a capture against its description: rate, holes, wraps, steps, and values that repeat."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from sms_online.sample_faults import TURNS, unit_of_stamps, wrapped_at
from sms_online.stream import Array

# Samples that are judged together: enough for a median, less than a phase of a motion.
CHUNK = 2048
# First intervals whose median is the period.
INTERVALS = 512
# A rate off by more than this share of the described one is another rate.
RATE_TOLERANCE = 0.02
# An interval of more periods than this is a hole, as for the synchroniser.
HOLE = 5
# Steps are multiples of a resolution where they are so to this share of it, and no more of them fit the range.
WHOLE, MOST_STEPS = 0.01, 1e6
# A channel whose samples repeat less often than this shows no resolution.
REPEATED = 0.2
# A resolution this many times the described one is another.
COARSER = 1.5
# Stamps in another unit of time are recognised to this factor.
UNIT_TOLERANCE = 3.0
# A channel of fewer samples is not judged.
LEAST = 20


@dataclass(frozen=True)
class Remark:
    """What is the matter with a channel, or with the whole capture, whose channel is "".

    grave: estimates will suffer from it.
    """

    channel: str
    text: str
    grave: bool


@dataclass
class ChannelCheck:
    """Judges one channel, samples in order of time.

    unit: of its values. period: described, s; None where no sensor is. resolution: described, 0 where none is.
    """

    name: str
    unit: str
    period: float | None
    resolution: float = 0.0
    samples: int = 0
    low: float = math.inf
    high: float = -math.inf
    longest: float = 0.0  # interval, s
    holes: int = 0
    turns: int = 0
    held: dict[float, list[int]] = field(default_factory=dict)  # value: runs and samples in which the sensor hung at it
    _intervals: list[float] = field(default_factory=list)
    _first: float = math.nan
    _last: float = math.nan
    _hole: float = math.nan
    _steps: float = math.inf  # smallest, while all are multiples of it
    _whole: bool = True
    _repeated: int = 0
    _waiting: list[Array] = field(default_factory=list)
    _held_at: float = math.nan

    def push(self, t: Array, values: Array) -> None:
        """Take samples: times (B,), s, and values (B,), all finite."""
        if not t.size:
            return
        self._first = float(t[0]) if math.isnan(self._first) else self._first
        if len(self._intervals) < INTERVALS:
            known = [] if math.isnan(self._last) else [self._last]
            self._intervals += np.diff(np.concatenate((known, t))).tolist()[: INTERVALS - len(self._intervals)]
        intervals = np.diff(t, prepend=t[0] if math.isnan(self._last) else self._last)
        self.longest = max(self.longest, float(intervals.max()))
        period = self.measured_period
        if period is not None:
            holes = np.flatnonzero(intervals > (HOLE + 0.5) * period)
            self.holes += holes.size
            if holes.size and math.isnan(self._hole):
                self._hole = float(t[holes[0]] - intervals[holes[0]])
        self._last = float(t[-1])
        self.samples += t.size
        self.low, self.high = min(self.low, float(values.min())), max(self.high, float(values.max()))
        self._waiting.append(values)
        if sum(part.size for part in self._waiting) >= CHUNK:
            self._judge()

    def hung(self, values: Array) -> None:
        """Take values of consecutive samples at which the sensor hung."""
        for value in values.tolist():
            runs = self.held.setdefault(value, [0, 0])
            runs[0] += value != self._held_at
            runs[1] += 1
            self._held_at = value

    def moved(self) -> None:
        """The sensor does not hang any more."""
        self._held_at = math.nan

    @property
    def measured_period(self) -> float | None:
        """Median of the first intervals, s; None before there are enough."""
        return float(np.median(self._intervals)) if len(self._intervals) >= LEAST else None

    def _judge(self) -> None:
        """Look at the samples that wait, and keep the last one for the next ones."""
        x = np.concatenate(self._waiting)
        self._waiting = [x[-1:]]
        size = np.abs(np.diff(x))
        wrapped = wrapped_at(size) if self.unit == "rad" else None
        if wrapped is not None and wrapped[0] == TURNS[0]:
            self.turns += wrapped[1]
        moved = size[size > 0.0]
        self._repeated += int(np.count_nonzero(size == 0.0))
        if self._whole and moved.size:
            self._steps = min(self._steps, float(moved.min()))
            share = moved / self._steps
            self._whole = bool((np.abs(share - np.rint(share)) < WHOLE).all())

    def remarks(self) -> Iterator[Remark]:
        """What is the matter, by what has come so far."""
        if sum(part.size for part in self._waiting) > LEAST:
            self._judge()
        if not self.samples:
            yield self._remark("no sample", True)
        if self.samples < LEAST:
            return
        yield from self._of_time()
        if self.low == self.high:
            yield self._remark(f"never changes from {self.low:.6g} {self.unit}".rstrip(), True)
            return
        at_end = {value: runs for value, runs in self.held.items() if value in (self.low, self.high)}
        if sum(runs for runs, _ in at_end.values()) > 1:
            shown = ", ".join(f"{value:.6g}" for value in at_end)
            count = sum(samples for _, samples in at_end.values())
            yield self._remark(f"saturated at {shown} {self.unit}, {count} samples", True)
        elif self.held:
            value, (_, count) = max(self.held.items(), key=lambda each: each[1][1])
            yield self._remark(f"stuck at {value:.6g} {self.unit}, {count} samples", True)
        if self.turns:
            yield self._remark(f"wraps, {self.turns} steps of a whole turn: state `wrap` in its source", True)
        yield from self._of_steps()

    def _of_time(self) -> Iterator[Remark]:
        period = self.measured_period
        if period is None or period <= 0.0:
            return
        if self.period is not None:
            ratio = period / self.period
            stamps = unit_of_stamps(ratio, UNIT_TOLERANCE)
            if stamps is not None:
                yield self._remark(f"time in {stamps[0]}, not in s: a sample every {period:g}", True)
                return
            if abs(ratio - 1.0) > RATE_TOLERANCE:
                yield self._remark(f"{1.0 / period:.5g} Hz, described as {1.0 / self.period:g} Hz", True)
        if self.holes:
            where = f"the first at {self._hole:.3f} s, the longest of {self.longest:.3g} s"
            yield self._remark(f"{self.holes} holes of more than {HOLE} samples, {where}", False)

    def _of_steps(self) -> Iterator[Remark]:
        if not (self._whole and math.isfinite(self._steps) and self.high - self.low < MOST_STEPS * self._steps):
            return
        if self.resolution > 0.0 and self._steps > COARSER * self.resolution:
            found = f"steps of {self._steps:.3g} {self.unit}, described as {self.resolution:.3g}"
            yield self._remark(found, True)
        elif self.resolution == 0.0 and self._repeated > REPEATED * self.samples:
            yield self._remark(f"steps of {self._steps:.3g} {self.unit}, no resolution described", False)

    def _remark(self, text: str, grave: bool) -> Remark:
        return Remark(self.name, text, grave)
