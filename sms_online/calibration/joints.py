"""What nuisances do to torques of joints: by the deflections that encoders read, and in the torques themselves.

A stiff spring makes of an encoder's zero within its tolerance as much as a joint's torque. What else calibration does
to the rows of joints is little beside it.
"""

from __future__ import annotations

import numpy as np

from sms_online.calibration.channels import Families, Motion, added, nuisances_of
from sms_online.calibration.columns import nuisances
from sms_online.pipeline.sensing import Sensing
from sms_online.stream import Array


class JointCalibration:
    """Evaluates what joints' deflections and torques are read too much for one unit of each nuisance.

    of_positions, of_torques: these nuisances. positions, torques: their numbers among all of a session, see
    `calibration.columns.nuisances`.
    """

    def __init__(self, sensing: Sensing) -> None:
        layout, self._families = sensing.model.layout, Families.of(sensing)
        of = (self._families.positions, self._families.torques)
        self.of_positions, self.of_torques = (nuisances_of(each) for each in of)
        number = {nuisance: k for k, nuisance in enumerate(nuisances(sensing))}
        self.positions, self.torques = ([number[each] for each in own] for own in (self.of_positions, self.of_torques))
        # Any positions serve: rows of joints do not depend on them. Euler parameters of no rotation end with η = 1.
        positions = np.array([[name == "eta" for name in layout.position_names]], dtype=np.float64)
        along = sensing.displacements(positions)[0]
        self._deflection = along[list(layout.theta_m)] - along[list(layout.q)]

    def deflections(self, motion: Motion) -> Array:
        """By how much deflections are read too large, (K, joints, positions)."""
        return np.asarray(self._deflection @ added(self._families.positions, motion, self._deflection.shape[1]))

    def torque(self, motion: Motion) -> Array:
        """By how much torques n τ are read too large, (K, joints, torques)."""
        return added(self._families.torques, motion, motion.torque.shape[1])
