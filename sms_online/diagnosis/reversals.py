"""The rate of a motor as forces need it that jump with its sign, and how well its reversals are told.

What dry friction does when its motor turns round bends the motor's rate, and a filter as wide as the smooth motion
allows rounds the bend off: the zero of the rate is told milliseconds beside the true one, in every reversal on the same
side. So the rate comes through a narrow filter, whose noise scatters, and what is left of both is told by the rate's
noise and by what a wider filter says. And an integral over samples knows a jump to half a sample; forces are
averaged over instants between them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_online.diagnosis.record import Segment
from sms_online.diagnosis.weak_windows import Motion
from sms_online.effects.friction import STANDSTILL
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.smoothing import HALF_WIDTHS, kernel, smooth_all
from sms_online.stream import Array

# Half width of the filter at most, s.
HALF_WIDTH = 0.028
# Instants of a sample, in samples from its middle, that a force is averaged over.
WITHIN = (-0.4, -0.2, 0.0, 0.2, 0.4)
# A reversal is off by no more than this, s: an axis that turns round more slowly stands still.
LARGEST = 0.06
# Rates on both sides of a jump, in multiples of what counts as standstill.
BESIDE = 10.0


class Reversals:
    """Rates of one motor.

    joint: of the motor, by number from 0. noise: σ of its position, rad.
    """

    def __init__(
        self, sensing: Sensing, segments: Sequence[Segment], joint: int, noise: float, sample_rate: float
    ) -> None:
        layout = sensing.model.layout
        self.motor = layout.theta_m[joint]
        column = self.motor + layout.n_base_positions - layout.n_base_speeds
        self._angles = [sensing.coordinates(segment.values)[:, [column]] for segment in segments]
        self._noise, self._rate = noise, sample_rate
        self._widest = max(HALF_WIDTHS[0], round(HALF_WIDTH * sample_rate))
        self._known: dict[tuple[int, int], Array] = {}

    def _rates(self, motion: Motion, M: int, at: NDArray[Any]) -> Array:
        """θ̇_m (K,) at samples `at` (K,) between whole ones, rad/s."""
        key = motion.segment, M
        if key not in self._known:
            self._known[key] = smooth_all(self._angles[motion.segment], M, self._rate)[1][:, 0]
        known = self._known[key]
        return np.asarray(np.interp(at, np.arange(known.size) + M, known))

    def _deviation(self, motion: Motion, M: int) -> Array:
        """1σ (K,) of the rate by noise, and what the filter rounds off, rad/s.

        That is in proportion to its width: one of twice the width rounds off as much again.
        """
        own, wide = kernel(M)[:, 1], kernel(2 * M)[:, 1]
        alone, between = (self._noise * float(np.linalg.norm(w)) * self._rate for w in (own, wide - np.pad(own, M)))
        more = self._rates(motion, 2 * M, motion.samples) - self._rates(motion, M, motion.samples)
        return np.asarray(np.sqrt(alone**2 + np.maximum(0.0, more**2 - between**2)))

    def mean(self, force: Callable[[Array], Array], motion: Motion) -> Array:
        """Forces (K, n_v, c) of speeds (K, n_v), averaged over each sample of a motion."""
        M = min(motion.half_width, self._widest)
        v = motion.v.copy()
        total: Array | float = 0.0
        for part in WITHIN:
            v[:, self.motor] = self._rates(motion, M, motion.samples + part)
            total = total + force(v)
        return np.asarray(total / len(WITHIN))

    def squares(self, force: Callable[[Array], Array], motion: Motion) -> Array:
        """Squares (K, n_v) of what a force (K, n_v) of speeds is off by at the samples before a reversal."""
        M = min(motion.half_width, self._widest)
        rate = self._rates(motion, M, motion.samples)
        slope = np.diff(rate, append=rate[-1:])
        turns = (np.diff(np.sign(rate), append=np.sign(rate[-1:])) != 0.0) & (
            np.diff(motion.samples, append=motion.samples[-1:]) == 1
        )
        off = np.zeros_like(rate)  # in samples
        off[turns] = np.minimum(self._deviation(motion, M)[turns] / np.abs(slope[turns]), LARGEST * self._rate)
        sides = []
        for side in (BESIDE * STANDSTILL, -BESIDE * STANDSTILL):
            v = motion.v.copy()
            v[:, self.motor] = side
            sides.append(force(v))
        return np.asarray(((sides[0] - sides[1]) * off[:, None]) ** 2)
