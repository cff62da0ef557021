"""From the declarations of a system file to effects."""

from __future__ import annotations

from sms_online.description.explain import hint, nearest
from sms_online.description.schema import Effect, System
from sms_online.effects.base import ForceEffect
from sms_online.effects.joint import CoulombFriction, TorqueOffset, ViscousFriction
from sms_online.errors import InputError

NAMES = ("coulomb_friction", "torque_offset", "viscous_friction")
COEFFICIENT = {"coulomb_friction": "torque", "torque_offset": "torque", "viscous_friction": "damping"}


def build_effects(system: System) -> tuple[ForceEffect, ...]:
    """Effects declared in a system, in its order; InputError on an unknown name, place or coefficient."""
    return tuple(_build(system, effect, f"effect {k}") for k, effect in enumerate(system.effects, start=1))


def _build(system: System, effect: Effect, place: str) -> ForceEffect:
    if effect.name not in NAMES:
        expected = f"one of {', '.join(NAMES)}{hint(nearest(effect.name, NAMES))}"
        raise InputError(system.name, place, f"unknown effect {effect.name!r}", expected)
    joints = [f"joint_{i}" for i in range(1, len(system.joints) + 1)]
    if effect.where not in joints:
        raise InputError(system.name, place, f"{effect.name} at {effect.where!r}", f"one of {', '.join(joints)}")
    coefficient = COEFFICIENT[effect.name]
    unknown = set(effect.coefficients) - {coefficient}
    if unknown:
        raise InputError(system.name, place, f"coefficient {min(unknown)!r} of {effect.name}", f"{coefficient!r}")
    i = joints.index(effect.where) + 1
    joint = system.joints[i - 1]
    nominal = effect.coefficients.get(coefficient, 0.0)
    prismatic = joint.kind == "prismatic"
    if effect.name == "viscous_friction":
        return ViscousFriction(i, nominal, prismatic)
    if effect.name == "coulomb_friction":
        return CoulombFriction(i, nominal, prismatic)
    return TorqueOffset(i, nominal, joint.gear_ratio, prismatic)
