"""Where a motor stands still in a whole session."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sms_online.diagnosis.record import Segment
from sms_online.effects.base import position
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.smoothing import smooth_all
from sms_online.pipeline.standstill import lasting, rate_filter, slowest


class Standstill:
    """Where one motor stands still in a session.

    joint: of the motor, by number from 0. noise: σ of its position, rad. slow: the rate below which it stands still,
    rad/s.
    """

    def __init__(
        self, sensing: Sensing, segments: Sequence[Segment], joint: int, noise: float, sample_rate: float
    ) -> None:
        layout = sensing.model.layout
        self.motor = layout.theta_m[joint]
        self._half_width = M = rate_filter(sample_rate)
        self.slow = slowest(noise, M, sample_rate)
        angles = [position(layout, sensing.coordinates(each.values), self.motor)[:, None] for each in segments]
        rates = [smooth_all(angle, M, sample_rate)[1][:, 0] for angle in angles]
        self._still = [lasting(np.abs(rate) < self.slow, sample_rate) for rate in rates]

    @cached_property
    def share(self) -> float:
        """Share of the session in which it does."""
        return float(np.mean(np.concatenate(self._still)))

    def at(self, number: int, samples: NDArray[np.int64]) -> NDArray[np.bool_]:
        """At which samples (K,) of a segment it does."""
        still = self._still[number]
        return still[np.clip(samples - self._half_width, 0, still.size - 1)]
