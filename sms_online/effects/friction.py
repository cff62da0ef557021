"""Friction of a motor shaft against the stator, at the output side of the gear, and of the bearing behind the spring.

Source of the laws: Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30 (1994) 1083; load-dependent friction of
gears: Bittencourt, Gunnarsson, J. Dynamic Systems, Measurement and Control 134 (2012) 051013; friction with memory:
Dahl, AIAA J. 14 (1976) 1675.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sms_online.description.channels import has_motor_side
from sms_online.effects.base import STANDSTILL, Entry, Force, Shape, Site, dahl_rate, deflection, shares_of
from sms_online.effects.traits import Curve, Traits
from sms_online.model.effect import Inputs
from sms_online.model.layout import Layout
from sms_online.stream import Array

# Effects and their coefficients for the attributes of <dynamics> in a URDF, friction of a joint as they are.
URDF_DYNAMICS = {"damping": ("viscous_friction", "damping"), "friction": ("coulomb_friction", "torque")}


def sign(rate: Array) -> Array:
    """Sign of a rate as tanh(rate / STANDSTILL), so that one definition serves rows and integration."""
    return np.asarray(np.tanh(rate / STANDSTILL))


class MotorSide(Force):
    """A generalized force along the axis of one joint's motor, θ_m."""

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """Force (B, coefficients) of one unit of each coefficient."""
        raise NotImplementedError

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """`along` on the row of the axis."""
        f = np.zeros((*v.shape, len(self.parameters)))
        f[:, self.axis(layout)] = self.along(layout, x, v, inputs)
        return f

    def rate(self, layout: Layout, v: Array) -> Array:
        """Rate of the axis (B,)."""
        return v[:, self.axis(layout)]


class ViscousFriction(MotorSide):
    """f = -c θ̇_m on the motor side, c `damping` in N m s/rad (N s/m on a prismatic joint).

    Limitations: linear; bearing friction that depends on load, temperature or direction is not in it.
    """

    entry = Entry(
        "viscous_friction", "force", "joint", {"damping": "N m s/rad"}, "two speeds, each held in both directions",
        traits=Traits(curve=Curve("motor speed"), begins=True),
    )  # fmt: skip

    symbols = ("d_{}",)

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """Minus the rate of the axis."""
        return -self.rate(layout, v)[:, None]


class CoulombFriction(MotorSide):
    """f = -c sign(θ̇_m), c `torque` in N m at the output side (N on a prismatic joint); power -c |θ̇_m|.

    Limitations: no stiction and no presliding; around standstill the sign of a noisy rate is noise.
    """

    entry = Entry(
        "coulomb_friction", "force", "joint", {"torque": "N m"}, "two speeds, each held in both directions",
        traits=Traits(course="dry", curve=Curve("motor speed"), begins=True),
    )  # fmt: skip

    symbols = ("c_{}",)

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """Minus the sign of the rate of the axis."""
        return -sign(self.rate(layout, v))[:, None]


class StribeckFriction(MotorSide):
    """f = -c sign(θ̇_m) exp(-(θ̇_m / v_s)²): what friction loses as the axis picks up speed.

    c: `torque`, N m; v_s: shape constant `velocity`, rad/s.
    Limitations: comes on top of Coulomb friction; no lag between speed and friction.
    """

    entry = Entry(
        "stribeck_friction", "force", "joint", {"torque": "N m"}, "slow motion through standstill, and fast motion",
        {"velocity": Shape("rad/s", 0.05, shares_of("speed", 0.01, 0.03, 0.1, 0.2, 0.4))},
        traits=Traits(course="dry", curve=Curve("motor speed")),
    )  # fmt: skip

    symbols = ("c_s{}",)

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """-sign(θ̇_m) exp(-(θ̇_m / v_s)²)."""
        rate = self.rate(layout, v)
        return -(sign(rate) * np.exp(-((rate / self.shapes["velocity"]) ** 2)))[:, None]


class DahlFriction(MotorSide):
    """f = -c z / w with ż = r - |r| z / w of a rate r, w the shape constant `width`. The state z starts at 0."""

    n_states = 1

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """-z / w."""
        assert inputs is not None
        return -inputs.states / self.shapes["width"]

    def state_rate(self, layout: Layout, x: Array, v: Array, z: Array) -> Array:
        """r - |r| z / w."""
        return dahl_rate(self.rate(layout, v), z, self.shapes["width"])


class PreslidingFriction(DahlFriction):
    """f = -c z / w with ż = θ̇_m - |θ̇_m| z / w: friction that builds up over a way, and remembers where it comes from.

    c: `torque` once the axis slides, N m. w: shape constant `width`, the way over which it builds up, rad at the output
    side. Beside Coulomb friction it is the part that contacts take up before they slide. The state z starts at 0.
    Limitations: rate-independent; small closed motions creep.
    """

    entry = Entry(
        "presliding_friction", "force", "joint", {"torque": "N m"},
        "slow reversals with small and large motion between them",
        {"width": Shape("rad", 0.001, shares_of("swing", 0.0003, 0.001, 0.003, 0.01, 0.03))},
    )  # fmt: skip
    symbols = ("c_p{}",)


class LoadFriction(MotorSide):
    """f = -c |ℓ| sign(θ̇_m): friction in proportion to the load ℓ of the gear, c the `ratio`.

    Behind a flexible joint ℓ is the spring's torque k δ, δ = θ_m - q, and linear in π is c k, `friction_stiffness`,
    N m/rad. Behind a rigid one ℓ is the motor's torque n τ, and c itself is linear.
    Limitations: the spring's torque is without the damper's; the motor's holds that of friction and of the rotor.
    """

    entry = Entry(
        "load_friction", "force", "driven joint", {"ratio": ""}, "the same speeds under little and much load",
        # Gears lose up to a third of their load; one that loses more than half is locked by it.
        traits=Traits(course="dry", limits={"ratio": (0.0, 0.5)}),
    )  # fmt: skip
    symbols = ("c_l{}",)

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        ratio, joint = given.get("ratio", 0.0), site.system.joints[site.index - 1]
        if has_motor_side(joint):
            linear = {"friction_stiffness": (f"c k_{site.index}", "N m/rad", ratio * joint.stiffness)}
            super().__init__(site, given, linear)
            self.relative_to = (f"joint_{site.index}.stiffness",)
        else:
            super().__init__(site, given)
            self.needs_torque = True

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """-|δ| sign(θ̇_m) or -|n τ| sign(θ̇_m)."""
        if self.needs_torque:
            assert inputs is not None
            load = inputs.torque[:, self.index - 1]
        else:
            load = deflection(layout, x, self.index - 1)
        return -(np.abs(load) * sign(v[:, layout.theta_m[self.index - 1]]))[:, None]

    def reported(self, values: Array) -> dict[str, float]:
        """c, which behind a spring is c k / k."""
        return {"ratio": float(values[0] if self.needs_torque else values[0] / values[1])}


class DirectionFriction(MotorSide):
    """Viscous friction that depends on the direction of travel: f = -c_± θ̇_m, c_+ for θ̇_m > 0, in N m s/rad.

    Equal coefficients `plus` and `minus` are viscous friction. Coulomb friction with a torque for each direction is
    Coulomb friction and a torque offset, from which no motion distinguishes it.
    """

    entry = Entry(
        "direction_friction", "force", "joint", {"plus": "N m s/rad", "minus": "N m s/rad"},
        "two speeds in both directions",
        # Beside the viscous friction that it refines a coefficient is a difference, of either sign.
        traits=Traits(signed=True, course="reversing", curve=Curve("motor speed"), extends=ViscousFriction.entry.name),
    )  # fmt: skip

    symbols = ("d_+{}", "d_-{}")

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """-θ̇_m forwards and backwards."""
        rate = self.rate(layout, v)
        return -np.stack((np.maximum(rate, 0.0), np.minimum(rate, 0.0)), axis=1)


class LinkSide(MotorSide):
    """A generalized force along q of one joint, between links that the joint's spring is in parallel to."""

    def axis(self, layout: Layout) -> int:
        """That of the joint behind its spring."""
        return layout.q[self.index - 1]


class BearingViscousFriction(LinkSide, ViscousFriction):
    """f = -c q̇ on the link side of the spring, c `damping` in N m s/rad (N s/m on a prismatic joint).

    Limitations: linear, as viscous friction on the motor side.
    """

    entry = Entry(
        "bearing_viscous_friction", "force", "flexible joint", {"damping": "N m s/rad"},
        "fast and slow motion with the load that the spring carries at both",
    )  # fmt: skip

    symbols = ("d_b{}",)


class BearingCoulombFriction(LinkSide, CoulombFriction):
    """f = -c sign(q̇) on the link side of the spring, c `torque` in N m (N on a prismatic joint).

    The spring carries it, so that it deflects by c / k where the axis comes to rest.
    Limitations: no stiction and no presliding, as Coulomb friction on the motor side.
    """

    entry = Entry(
        "bearing_coulomb_friction", "force", "flexible joint", {"torque": "N m"},
        "reversals under little load, slow and fast",
        traits=Traits(course="dry"),
    )  # fmt: skip

    symbols = ("c_b{}",)
