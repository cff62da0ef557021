"""What nuisances do to torques of joints: by the deflections that encoders read, and in the torques themselves.

A stiff spring makes of an encoder's zero within its tolerance as much as a joint's torque. What else calibration does
to the rows of joints is little beside it.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain

import numpy as np

from sms_online.calibration.channels import Family, Motion, TorqueFamily, position_families, torque_families
from sms_online.calibration.columns import nuisances
from sms_online.calibration.nuisance import Nuisance
from sms_online.pipeline.sensing import Sensing
from sms_online.stream import Array


class JointCalibration:
    """Evaluates what joints' deflections and torques are read too much for one unit of each nuisance.

    of_positions, of_torques: these nuisances. positions, torques: their numbers among all of a session, see
    `calibration.columns.nuisances`.
    """

    def __init__(self, sensing: Sensing) -> None:
        layout, tolerances = sensing.model.layout, sensing.model.system.tolerances
        self._positions, self._torques = position_families(sensing, tolerances), torque_families(sensing, tolerances)
        self.of_positions, self.of_torques = _nuisances(self._positions), _nuisances(self._torques)
        number = {nuisance: k for k, nuisance in enumerate(nuisances(sensing))}
        self.positions, self.torques = ([number[each] for each in own] for own in (self.of_positions, self.of_torques))
        # Any positions serve: rows of joints do not depend on them. Euler parameters of no rotation end with η = 1.
        positions = np.array([[name == "eta" for name in layout.position_names]], dtype=np.float64)
        along = sensing.displacements(positions)[0]
        self._deflection = along[list(layout.theta_m)] - along[list(layout.q)]

    def deflections(self, motion: Motion) -> Array:
        """By how much deflections are read too large, (K, joints, positions)."""
        out = np.concatenate([each.adds(motion) for each in self._positions], axis=2) if self._positions else None
        return np.zeros((len(motion.readings), len(self._deflection), 0)) if out is None else self._deflection @ out

    def torque(self, motion: Motion) -> Array:
        """By how much torques n τ are read too large, (K, joints, torques)."""
        out = [each.adds(motion) for each in self._torques]
        return np.concatenate(out, axis=2) if out else np.zeros((*motion.torque.shape, 0))


def _nuisances(families: Iterable[Family | TorqueFamily]) -> tuple[Nuisance, ...]:
    return tuple(chain.from_iterable(family.nuisances for family in families))
