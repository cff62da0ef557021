"""A rigid arm of three axes with gravity, whose last two cross as those of a wrist do."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from sms_online.capture import Capture
from sms_online.description.parse import parse_system
from sms_online.description.schema import Effect, System
from sms_online.effects.build import build_model
from sms_online.stream import Array

TEXT = """
name = "rigid-arm"
motion = "spatial"
gravity = [0.0, 0.0, -9.81]
sample_rate = 250.0
"""

JOINT = """
[joint_{i}]
axis = {axis}
transmission = "rigid"
gear_ratio = {gear}

[motor_{i}]
rotor_inertia = {rotor}

[link_{i}]
kind = "rigid"
mass = {mass}
center_of_mass = {center}
inertia = {{ xx = {xx}, yy = {yy}, zz = {zz}, xy = 0.0, xz = 0.0, yz = 0.0 }}
tip = {tip}
"""

AXES = (
    {"axis": [0.0, 0.0, 1.0], "gear": 100.0, "rotor": 2e-4, "mass": 8.0, "center": [0.0, 0.05, 0.2], "xx": 0.5,
     "yy": 0.4, "zz": 0.3, "tip": [0.0, 0.0, 0.4]},
    {"axis": [0.0, 1.0, 0.0], "gear": 100.0, "rotor": 1e-4, "mass": 4.0, "center": [0.15, 0.02, 0.0], "xx": 0.05,
     "yy": 0.2, "zz": 0.18, "tip": [0.4, 0.0, 0.0]},
    {"axis": [1.0, 0.0, 0.0], "gear": 50.0, "rotor": 5e-5, "mass": 1.5, "center": [0.05, 0.03, 0.04], "xx": 0.02,
     "yy": 0.015, "zz": 0.012, "tip": [0.1, 0.0, 0.0]},
)  # fmt: skip


def rigid_arm(*effects: Effect) -> System:
    """The arm with effects."""
    text = TEXT + "".join(JOINT.format(i=i, **axis) for i, axis in enumerate(AXES, start=1))
    return parse_system(text, "rigid-arm").model_copy(update={"effects": effects})


def with_friction(*effects: Effect) -> System:
    """The arm with Coulomb and viscous friction at every axis, and further effects."""
    laws = [
        Effect(name=name, where=f"joint_{i}", coefficients={quantity: size / i})
        for i in range(1, len(AXES) + 1)
        for name, quantity, size in (("coulomb_friction", "torque", 6.0), ("viscous_friction", "damping", 8.0))
    ]
    return rigid_arm(*laws, *effects)


def recorded(
    system: System, duration: float, seed: int, carried: Array | None = None, lost: Array | None = None
) -> Capture:
    """Samples of the arm on a trajectory of five sines an axis, from inverse dynamics: no motion is integrated.

    Torques have 1 % noise of 0.2 s memory and white noise of 0.5 %, encoders 1e-5 rad. carried (B,): factor of what the
    payload weighs, of a system that has one. lost (n,): share of each gear's load, friction aside, that it loses.
    """
    rng = np.random.default_rng(seed)
    model = build_model(system)
    n = len(system.joints)
    t = np.arange(round(duration * system.sample_rate)) / system.sample_rate
    omega = 2.0 * np.pi * np.array([0.1, 0.2, 0.4, 0.7, 1.1])
    a, b = rng.uniform(-0.5, 0.5, size=(2, n, omega.size)) / (1.0 + omega)
    s, c = np.sin(np.outer(t, omega)), np.cos(np.outer(t, omega))
    x, v = s @ a.T + c @ b.T, (c * omega) @ a.T - (s * omega) @ b.T
    acceleration = -(s * omega**2) @ a.T - (c * omega**2) @ b.T

    def torque(pi: Array) -> Array:
        H, C = model.dynamics(pi).mass_and_bias(x, v)
        return np.asarray(np.einsum("bij,bj->bi", H, acceleration) + C)

    tau = torque(model.nominal)
    if carried is not None:
        own = np.array([p.name.startswith("payload.") for p in model.parameters])
        empty = torque(np.where(own, 0.0, model.nominal))
        tau = empty + carried[:, None] * (tau - empty)
    if lost is not None:
        plain = build_model(system.model_copy(update={"effects": ()}))
        H, C = plain.dynamics(plain.nominal).mass_and_bias(x, v)
        tau = tau + lost * np.abs(np.einsum("bij,bj->bi", H, acceleration) + C) * np.sign(v)
    size = np.sqrt(np.mean(tau**2, axis=0))
    memory = np.exp(-1.0 / (0.2 * system.sample_rate))
    slow = lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], rng.normal(size=tau.shape), axis=0)
    tau = tau + size * (0.01 * slow + 0.005 * rng.normal(size=tau.shape))
    q = x + 1e-5 * rng.normal(size=x.shape)
    gears = [joint.gear_ratio for joint in system.joints]
    values = {f"tau_{i + 1}": tau[:, i] / gears[i] for i in range(n)} | {f"q_{i + 1}": q[:, i] for i in range(n)}
    return Capture.from_arrays(t, values)
