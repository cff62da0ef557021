"""Effects that act on a motor shaft against the stator: viscous and Coulomb friction, torque offset."""

from __future__ import annotations

import numpy as np

from sms_online.model.layout import Layout
from sms_online.model.parameters import Parameter
from sms_online.stream import Array

# Speed below which an axis stands still, rad/s (m/s): an integrator cannot follow a jump, and encoders resolve no less.
STANDSTILL = 1e-4


class _MotorSide:
    """A generalized force along θ_m of joint i (from 1), one coefficient."""

    def __init__(self, i: int, parameter: Parameter) -> None:
        self.i = i
        self.parameters: tuple[Parameter, ...] = (parameter,)

    def along(self, rate: Array) -> Array:
        """Force (B,) of one unit of the coefficient at motor rates θ̇_m (B,)."""
        raise NotImplementedError

    def force(self, layout: Layout, x: Array, v: Array) -> Array:
        """Column (B, n_v, 1)."""
        f = np.zeros((*v.shape, 1))
        column = layout.theta_m[self.i - 1]
        f[:, column, 0] = self.along(v[:, column])
        return f


class ViscousFriction(_MotorSide):
    """f = -c θ̇_m on the motor side, c in N m s/rad (N s/m on a prismatic joint).

    Limitations: linear; bearing friction that depends on load, temperature or direction is not in it.
    """

    def __init__(self, i: int, nominal: float, prismatic: bool) -> None:
        unit = "N s/m" if prismatic else "N m s/rad"
        super().__init__(i, Parameter(f"viscous_friction@joint_{i}.damping", f"d_{i}", unit, nominal))

    def along(self, rate: Array) -> Array:
        """-θ̇_m."""
        return -rate


class CoulombFriction(_MotorSide):
    """f = -c sign(θ̇_m), c in N m at the output side (N on a prismatic joint); power -c |θ̇_m|.

    The sign is tanh(θ̇_m / STANDSTILL), so that one definition serves rows and integration.
    Limitations: no stiction and no presliding; around standstill the sign of a noisy rate is noise.
    """

    def __init__(self, i: int, nominal: float, prismatic: bool) -> None:
        unit = "N" if prismatic else "N m"
        super().__init__(i, Parameter(f"coulomb_friction@joint_{i}.torque", f"c_{i}", unit, nominal))

    def along(self, rate: Array) -> Array:
        """-sign(θ̇_m)."""
        return -np.tanh(rate / STANDSTILL)


class TorqueOffset(_MotorSide):
    """The measured torque reads c too much at the motor shaft (N m; N on a direct drive), so the arm feels -n c.

    Limitations: constant over the session; a drifting amplifier needs a slower model.
    """

    def __init__(self, i: int, nominal: float, gear_ratio: float, prismatic: bool) -> None:
        unit = "N" if prismatic else "N m"
        super().__init__(i, Parameter(f"torque_offset@joint_{i}.torque", f"o_{i}", unit, nominal))
        self.gear_ratio = gear_ratio

    def along(self, rate: Array) -> Array:
        """-n."""
        return np.full_like(rate, -self.gear_ratio)
