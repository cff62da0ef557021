"""Numbers of a device to SI units: scale, limits, wraps and lost frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.description.sources import SerialField, Signal
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices, Mask, increments

Counters = dict[str, int]


class TurnsState(State):
    """The last number, NaN before the first, and the turn that it lies in."""

    last: float = np.nan
    turns: float = 0.0


class Turns(Stage):
    """Undoes the wrapping of a number, which moves by less than half its `wrap` between two samples.

    The first sample of all lies in turn 0. Limitation: a hole in which it moves further loses whole turns.
    """

    def __init__(self, wrap: float) -> None:
        self.wrap = wrap
        self.state = TurnsState()

    def count(self, numbers: Array) -> Array:
        """(B,) turns of the numbers (B,), which are finite: whole numbers to be added times `wrap`."""
        if not numbers.size:
            return numbers
        first = numbers[0] if np.isnan(self.state.last) else self.state.last
        # Whole numbers, so that the sum is exact and the same however the samples are grouped.
        steps = np.floor(increments(numbers, first) / self.wrap + 0.5)
        turns = self.state.turns - np.cumsum(steps)
        self.state.last, self.state.turns = float(numbers[-1]), float(turns[-1])
        return turns


class Conversions:
    """A device's numbers to channels. What is not finite or not plausible becomes NaN.

    signals: of K channels that are sampled together. counters: non_finite and out_of_range are counted there. turns: of
    the channels that wrap.
    """

    def __init__(self, signals: Sequence[Signal | SerialField], counters: Counters) -> None:
        self._counters = counters
        self._scale = np.array([signal.scale for signal in signals])
        self._offset = np.array([signal.offset for signal in signals])
        self._minimum = np.array([-np.inf if signal.minimum is None else signal.minimum for signal in signals])
        self._maximum = np.array([np.inf if signal.maximum is None else signal.maximum for signal in signals])
        self._turns = {k: Turns(signal.wrap) for k, signal in enumerate(signals) if signal.wrap is not None}
        self.turns = {str(signals[k].channel): turns for k, turns in self._turns.items()}

    def __call__(self, numbers: Array) -> Array:
        """(B, K) channel values of the numbers (B, K) of consecutive samples."""
        with np.errstate(over="ignore", invalid="ignore"):
            values: Array = numbers * self._scale + self._offset
        finite = np.isfinite(values)
        # NaN compares false, so that no value is counted twice.
        outside = (values < self._minimum) | (values > self._maximum)
        if not finite.all():
            outside &= finite
            self._counters["non_finite"] += int(np.count_nonzero(~finite))
            values[~finite] = np.nan
        if outside.any():
            self._counters["out_of_range"] += int(np.count_nonzero(outside))
            values[outside] = np.nan
        for k, turns in self._turns.items():
            # After the limits: one wrong word must not count as a turn.
            good = ~np.isnan(values[:, k])
            values[good, k] += turns.count(numbers[good, k]) * (turns.wrap * self._scale[k])
        return values


class FrameCounter:
    """Follows the count, modulo `modulus`, that a sender puts into its frames.

    Steps ahead of up to half the modulus are frames lost (lost_counter counts the missing ones, whole rounds unseen).
    A frame that repeats the count before is a duplicate (repeated_counter), one that goes back came late
    (late_counter); both are dropped. Two consecutive counts behind the last are a sender that was started again
    (restarted_counter); its first frame is dropped as late.
    """

    KINDS = ("repeated_counter", "lost_counter", "late_counter", "restarted_counter")

    def __init__(self, modulus: int, counters: Counters) -> None:
        self._modulus = modulus
        self._counters = counters
        self._last = -1  # count of the last frame admitted, -1 before the first
        self._late = -1  # count of the frame before, if that was dropped as late, else -1

    def admit(self, counts: Indices) -> Mask:
        """(B,) mask of the frames to use, from their counts (B,) in order of arrival."""
        admitted = np.ones(counts.size, dtype=np.bool_)
        if not counts.size:
            return admitted
        before = counts[0] - 1 if self._last < 0 else self._last
        steps = increments(counts, before) % self._modulus
        if np.all((steps > 0) & (steps <= self._modulus // 2)):
            self._counters["lost_counter"] += int(steps.sum()) - counts.size
            self._last, self._late = int(counts[-1]), -1
            return admitted
        for k, count in enumerate(counts.tolist()):
            admitted[k] = self._admit_one(count)
        return admitted

    def _admit_one(self, count: int) -> bool:
        ahead = 1 if self._last < 0 else (count - self._last) % self._modulus
        if ahead == 0:
            self._counters["repeated_counter"] += 1
            return False
        if ahead <= self._modulus // 2:
            self._counters["lost_counter"] += ahead - 1
        elif self._late >= 0 and (count - self._late) % self._modulus == 1:
            self._counters["restarted_counter"] += 1
        else:
            self._counters["late_counter"] += 1
            self._late = count
            return False
        self._last, self._late = count, -1
        return True
