"""Grid samples without what position sensors read too much: late, from another point, with another zero or scale."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import correlate1d

from sms_online.calibration.channels import Motion, position_families
from sms_online.effects.delay import ahead
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.synchronise import GridSamples
from sms_online.state import Stage, State
from sms_online.stream import Array

# What is added follows the corrected readings; from one pass to the next the rest shrinks as errors of scale are small.
PASSES = 2


class CorrectionState(State):
    """What a correction keeps: values (B, C), the last samples of a segment, which the next ones ask for."""

    values: Array
    segment: int = -1


class Correction(Stage):
    """Corrects the position sensors' channels by nuisances (m,); all others pass, as much later as clocks ask for."""

    def __init__(self, sensing: Sensing, sample_rate: float, nuisances: Array) -> None:
        self._sensing, self._nuisances = sensing, nuisances
        self._families = position_families(sensing, sensing.model.system.tolerances)
        self._columns = sensing.position_columns
        late = self._late()
        kernels = [ahead(seconds, sample_rate) for seconds in late.tolist()]
        self._kernels = {k: each for k, each, by in zip(self._columns, kernels, late, strict=True) if by != 0.0}
        self._margin = max((kernel.size // 2 for kernel in self._kernels.values()), default=0)
        self.state = CorrectionState(np.empty((0, 0)))

    def _late(self) -> Array:
        """Lateness of each position sensor (sensors,), s."""
        layout, sensors = self._sensing.model.layout, len(self._columns)
        turned = np.broadcast_to(np.eye(3), (1, 3, 3))
        still, torque = np.zeros((1, sensors)), np.zeros((1, len(layout.q)))
        moving, resting = Motion(still, still + 1.0, torque, turned), Motion(still, still, torque, turned)
        return np.asarray((self._added(resting) - self._added(moving))[0])

    def _added(self, motion: Motion) -> Array:
        """What the sensors read too much (K, sensors)."""
        out, first = np.zeros_like(motion.readings), 0
        for family in self._families:
            last = first + len(family.nuisances)
            out += family.adds(motion) @ self._nuisances[first:last]
            first = last
        return out

    def push(self, piece: GridSamples) -> list[GridSamples]:
        """The samples that can be corrected by now."""
        if not self._nuisances.any():
            return [piece]
        if piece.segment != self.state.segment:
            self.state.segment, self.state.values = piece.segment, piece.values[:0]
        values = np.concatenate((self.state.values, piece.values))
        self.state.values = values[max(0, len(values) - 2 * self._margin) :]
        inner = slice(self._margin, len(values) - self._margin)
        if inner.stop <= inner.start:
            return []
        corrected = values[inner].copy()
        for column, kernel in self._kernels.items():
            corrected[:, column] = correlate1d(values[:, column], kernel, mode="nearest")[inner]
        self._take_off(corrected)
        last = int(piece.index[-1]) - self._margin
        return [GridSamples(np.arange(last + 1 - len(corrected), last + 1, dtype=np.int64), corrected, piece.segment)]

    def _take_off(self, values: Array) -> None:
        """Everything but lateness."""
        read, layout = values[:, self._columns], self._sensing.model.layout
        torque = np.zeros((len(values), len(layout.q)))
        for _ in range(PASSES):
            now = values[:, self._columns]
            _, T_0 = layout.base_pose(self._sensing.coordinates(values[:, : len(self._sensing.channels)]))
            values[:, self._columns] = read - self._added(Motion(now, np.zeros_like(now), torque, T_0))
