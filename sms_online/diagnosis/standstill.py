"""Where a motor stands still in a whole session."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sms_online.diagnosis.record import Segment
from sms_online.effects.base import position
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.standstill import Standstill, rate_filter, slowest


class SessionStandstill:
    """Where one motor stands still in a session.

    joint: of the motor, by number from 0. noise: σ of its position, rad. slow: the rate below which it stands still,
    rad/s.
    """

    def __init__(
        self, sensing: Sensing, segments: Sequence[Segment], joint: int, noise: float, sample_rate: float
    ) -> None:
        layout = sensing.model.layout
        self.motor = layout.theta_m[joint]
        self.slow = slowest(noise, rate_filter(sample_rate), sample_rate)
        self._still = []
        for segment in segments:
            still = Standstill(1, sample_rate)
            still.push(position(layout, sensing.coordinates(segment.values), self.motor)[:, None], np.array([noise]))
            self._still.append(still.at(np.arange(segment.index.size))[:, 0])

    @cached_property
    def share(self) -> float:
        """Share of the session in which it does."""
        return float(np.mean(np.concatenate(self._still)))

    def at(self, number: int, samples: NDArray[np.int64]) -> NDArray[np.bool_]:
        """At which samples (K,) of a segment it does."""
        return self._still[number][samples]
