"""Physical parameters of a system: names, symbols, units, nominal values, and which body or spring each belongs to.

The order is that of the paper's Table V, which is also the order of preference when identifiable combinations are
formed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sms_online.description.bodies import FlexibleLink, Inertia, RigidBody
from sms_online.description.explain import hint, nearest
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.model.so3 import skew
from sms_online.stream import Array

SYMMETRIC = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}


@dataclass(frozen=True)
class Parameter:
    """One entry of π: dotted name, symbol, SI unit, nominal value."""

    name: str
    symbol: str
    unit: str
    nominal: float

    @property
    def owner(self) -> str:
        """The body, joint or effect that the parameter belongs to."""
        return self.name.rsplit(".", 1)[0]

    @property
    def quantity(self) -> str:
        """What the parameter measures."""
        return self.name.rsplit(".", 1)[1]


@dataclass(frozen=True)
class InertialParameter:
    """A parameter with its inertia matrix: constant (6, 6), or (7, 7) where the motor's rate is the seventh speed."""

    parameter: Parameter
    matrix: Array


def inertia_about_origin(body: RigidBody) -> Array:
    """Inertia (3, 3), kg m², about the origin of the body's frame (Steiner)."""
    i: Inertia = body.inertia
    about_center = np.array([[i.xx, i.xy, i.xz], [i.xy, i.yy, i.yz], [i.xz, i.yz, i.zz]])
    c = skew(np.array(body.center_of_mass))
    return np.asarray(about_center - body.mass * c @ c)


def _rotational(key: str) -> Array:
    """(6, 6) inertia matrix of one unit moment or product of inertia."""
    E = np.zeros((6, 6))
    a, b = SYMMETRIC[key]
    E[3 + a, 3 + b] = E[3 + b, 3 + a] = 1.0
    return E


def _translational() -> Array:
    """(6, 6) inertia matrix of one unit of mass at the origin."""
    return np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


def _coupling(axis: int, sign: float) -> Array:
    """(6, 6) inertia matrix of one unit of first moment along an axis."""
    E = np.zeros((6, 6))
    h = np.zeros(3)
    h[axis] = sign
    E[3:, :3] = skew(h)
    E[:3, 3:] = -skew(h)
    return E


def rigid_body(owner: str, index: str, body: RigidBody, planar: bool, spacecraft: bool) -> list[InertialParameter]:
    """Ten inertial parameters (planar: four) of a body about its frame's origin.

    The spacecraft follows the paper: inertia about joint 1, first moment m_0 r_0 with r_0 from the centre of mass to
    joint 1.
    """
    moments = ("zz",) if planar else tuple(SYMMETRIC)
    axes = (0, 1) if planar else (0, 1, 2)
    sign = -1.0 if spacecraft else 1.0
    what = "inertia_about_joint_1" if spacecraft else "inertia"
    I_origin = inertia_about_origin(body)
    out = []
    for key in moments:
        suffix = "" if planar else f"_{key}"
        name = f"{owner}.{what}{suffix}"
        symbol = f"I_{index}{suffix}" + (f"+m_{index} r_{index}²" if spacecraft and planar else "")
        out.append(
            InertialParameter(Parameter(name, symbol, "kg m²", float(I_origin[SYMMETRIC[key]])), _rotational(key))
        )
    arm = "r" if spacecraft else "c"
    for axis in axes:
        letter = "xyz"[axis]
        value = sign * body.mass * body.center_of_mass[axis]
        parameter = Parameter(f"{owner}.first_moment_{letter}", f"m_{index} {arm}_{index}{letter}", "kg m", value)
        out.append(InertialParameter(parameter, _coupling(axis, sign)))
    out.append(InertialParameter(Parameter(f"{owner}.mass", f"m_{index}", "kg", body.mass), _translational()))
    return out


def motor(i: int, system: System) -> tuple[InertialParameter, list[InertialParameter]]:
    """Rotor inertia, then stator inertia (planar: about z) and mass of motor i (from 1), (17)."""
    described, joint = system.motors[i - 1], system.joints[i - 1]
    assert described is not None
    c = np.concatenate((np.zeros(3), joint.axis, [joint.gear_ratio]))
    rotor = Parameter(f"motor_{i}.rotor_inertia", f"I_r{i}", "kg m²", described.rotor_inertia)
    stator = []
    for key in ("zz",) if system.motion == "planar" else tuple(SYMMETRIC):
        suffix = "" if system.motion == "planar" else f"_{key}"
        value = getattr(described.stator_inertia, key)
        parameter = Parameter(f"motor_{i}.stator_inertia{suffix}", f"I_s{i}{suffix}", "kg m²", value)
        stator.append(InertialParameter(parameter, _with_motor_rate(_rotational(key))))
    mass = Parameter(f"motor_{i}.mass", f"m_m{i}", "kg", described.mass)
    return InertialParameter(rotor, np.outer(c, c)), [
        *stator,
        InertialParameter(mass, _with_motor_rate(_translational())),
    ]


def _with_motor_rate(E: Array) -> Array:
    """A (6, 6) inertia matrix padded by the motor's rate, on which it does not depend."""
    padded = np.zeros((7, 7))
    padded[:6, :6] = E
    return padded


# Ends of the names of parameters whose forces grow with a deflection.
ELASTIC = ("stiffness", "rigidity", "rigidity_y", "rigidity_z")
RIGIDITIES = {
    "flexural_rigidity_z": "EI",
    "flexural_rigidity_y": "EI_y",
    "torsional_rigidity": "GI_p",
    "axial_rigidity": "EA",
}


def rigidity_parameter(i: int, rigidity: str, link: FlexibleLink, planar: bool) -> Parameter:
    """Rigidity of link i (from 1); in the plane there is one flexural rigidity, so it needs no axis."""
    name = "flexural_rigidity" if planar else rigidity
    symbol = RIGIDITIES[rigidity] if planar or rigidity != "flexural_rigidity_z" else "EI_z"
    unit = "N" if rigidity == "axial_rigidity" else "N m²"
    return Parameter(f"link_{i}.{name}", f"{symbol}_{i}", unit, getattr(link, rigidity))


def with_fitted(parameters: Sequence[Parameter], system: System) -> tuple[Parameter, ...]:
    """The parameters with the nominal values that a system states as fitted; InputError on an unknown name."""
    names = [parameter.name for parameter in parameters]
    for name in system.fitted:
        if name not in names:
            expected = f"the name of a parameter of this system{hint(nearest(name, names))}"
            raise InputError(system.name, f'fitted."{name}"', "no such parameter", expected)
    fitted = system.fitted
    return tuple(replace(p, nominal=fitted[p.name].value) if p.name in fitted else p for p in parameters)
