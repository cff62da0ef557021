"""Grid samples without what position sensors read too much: late, from another point, with another zero or scale."""

from __future__ import annotations

import numpy as np

from sms_online.calibration.channels import Families, Motion
from sms_online.effects.delay import ahead
from sms_online.pipeline.convolution import Convolution
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.synchronise import GridSamples
from sms_online.stream import Array

# What is added follows the corrected readings; from one pass to the next the rest shrinks as errors of scale are small.
PASSES = 2


class Correction(Convolution):
    """Corrects the position sensors' channels by nuisances (m,); all others pass, as much later as clocks ask for."""

    def __init__(self, sensing: Sensing, sample_rate: float, nuisances: Array) -> None:
        self._sensing, self._nuisances = sensing, nuisances
        self._families = Families.of(sensing).positions
        self._columns = sensing.position_columns
        late = self._late()
        kernels = [ahead(seconds, sample_rate) for seconds in late.tolist()]
        super().__init__({k: each for k, each, by in zip(self._columns, kernels, late, strict=True) if by != 0.0})

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
        return super().push(piece) if self._nuisances.any() else [piece]

    def _correct(self, values: Array) -> None:
        read, layout = values[:, self._columns], self._sensing.model.layout
        torque = np.zeros((len(values), len(layout.q)))
        for _ in range(PASSES):
            now = values[:, self._columns]
            _, T_0 = layout.base_pose(self._sensing.coordinates(values[:, : len(self._sensing.channels)]))
            values[:, self._columns] = read - self._added(Motion(now, np.zeros_like(now), torque, T_0))
