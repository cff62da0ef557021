"""Samples as measured, and with synthetic noise added and subtracted: how noise changes rows to second order."""

from __future__ import annotations

import numpy as np

from sms_online.pipeline.momentum_windows import COPIES
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.pipeline.stamp_jitter import RATE_SAMPLES, synthetic
from sms_online.state import Stage, State
from sms_online.stream import Array

# The synthetic noise is the same in every session, so that the same samples give the same bits.
SEED = 6


class CopiesState(State):
    """random: gives the synthetic noise. readings (·, sensors): last ones of the segment."""

    random: np.random.Generator
    readings: Array


class NoisyCopies(Stage):
    """Adds synthetic noise of the sensors to corrected grid samples. sample_rate: of the grid, Hz."""

    def __init__(self, sensing: Sensing, sample_rate: float) -> None:
        self._sensing, self._sample_rate = sensing, sample_rate
        self.state = CopiesState(np.random.default_rng(SEED), np.empty((0, len(sensing.position_columns))))

    def begin_segment(self) -> None:
        """Forget the readings of the last segment."""
        self.state.readings = self.state.readings[:0]

    def of(self, values: Array, noise: SensorNoise) -> list[Array]:
        """Coordinates and joint torques of samples (B, ·) as measured, and with noise added and subtracted."""
        measured = self._sensing.motion(values)
        if noise.exact:
            return [measured] * COPIES
        added = np.zeros_like(values)
        positions = list(self._sensing.position_columns)
        columns = [*positions, *self._sensing.torque_columns]
        added[:, columns] = self.state.random.standard_normal((values.shape[0], len(columns))) * noise.grid
        readings, before = values[:, positions], self.state.readings
        if noise.jitters:
            added[:, positions] += synthetic(noise.jitters, readings, before, self._sample_rate, self.state.random)
        self.state.readings = np.concatenate((before, readings))[-RATE_SAMPLES:]
        return [measured, self._sensing.motion(values + added), self._sensing.motion(values - added)]
