"""The joint controller of the simulator."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from sms_online.description.schema import Controller
from sms_online.stream import Array


class Reference(Protocol):
    """What joints are to follow."""

    def __call__(self, t: Array) -> tuple[Array, Array]:
        """q_d and q̇_d (B, joints) at instants t (B,), s."""


class JointPD:
    """n τ = K_p (q_d - q) + K_D (q̇_d - q̇), continuous in time, on the link-side angle q.

    On q and not on θ_m: that reproduces the size of the motion in the paper's figure 6 with its gains.
    """

    def __init__(self, controller: Controller, reference: Reference) -> None:
        self.reference = reference
        self.stiffness = np.array(controller.stiffness)
        self.damping = np.array(controller.damping)

    def __call__(self, t: Array, q: Array, q_dot: Array) -> Array:
        """Torque after the gear n τ (B, joints), N m (N), at instants t (B,) for q, q̇ (B, joints)."""
        q_d, q_d_dot = self.reference(t)
        return np.asarray(self.stiffness * (q_d - q) + self.damping * (q_d_dot - q_dot))
