"""Elastic coordinates of a link from its markers' readings, whether or not they are as many."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.model.flexible import LinkKinematics
from sms_online.model.rod import NEWTON_STEPS
from sms_online.stream import Array


class SensedShape:
    """Shape of a link with some of its markers' readings measured.

    Where they are fewer than the elastic coordinates, the shape is the static one: of all that agree with the readings
    the one of least strain energy, as a link takes that is only held at its markers. Limitation: the load along a
    moving link bends it otherwise; in the paper's example slopes are off by 0.012 rad of 0.17 rad then.

    measured: which of `kinematics.marker_names` are read; at least one.
    """

    def __init__(self, kinematics: LinkKinematics, measured: Sequence[int]) -> None:
        self._kinematics = kinematics
        self._measured = list(measured)
        self.complete = len(self._measured) == len(kinematics.marker_names)
        # Rigidities are not known here; each kind of strain counts alike.
        self._compliance = np.linalg.inv(np.sum(list(kinematics.stiffness.values()), axis=0))

    def coordinates(self, readings: Array) -> Array:
        """Elastic coordinates q_f (B, n_f) for readings (B, measured), m and rad."""
        if self.complete:
            return self._kinematics.coordinates(readings)
        q_f = np.zeros((readings.shape[0], self._kinematics.n_f))
        for _ in range(NEWTON_STEPS):
            J = self._kinematics.marker_jacobian(q_f)[:, self._measured]
            told = readings - self._kinematics.markers(q_f)[:, self._measured]
            bent = self._compliance @ J.swapaxes(1, 2)
            ahead = told[..., None] + J @ q_f[..., None]
            q_f = (bent @ np.linalg.solve(J @ bent, ahead))[..., 0]
        return q_f
