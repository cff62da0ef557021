"""A bench of one flexible joint and a rigid link. Undeclared are a slow link encoder, friction, a gain that wanders."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.integrate import solve_ivp
from scipy.signal import butter, lfilter

from sms_online.description.parse import parse_system
from sms_online.description.schema import System
from sms_online.stream import Array, Block

RATE, GEAR, DURATION = 500.0, 50.0, 20.0
# Rotor (at the output side) and link, kg m²; spring, N m/rad; its damping and viscous friction, N m s/rad.
I_M, I_L, K, B, F = 2e-3, 3.8e-3, 1.3, 2e-3, 4e-3
NOISE = np.array([1e-4, 1e-4, 1e-4])  # of torque at the shaft, N m, and of both encoders, rad
TEXT = """
name = "slow-encoder"
motion = "planar"
sample_rate = 500.0
[joint_1]
gear_ratio = 50.0
stiffness = {k}
damping = {b}
[motor_1]
rotor_inertia = {I_m}
[link_1]
kind = "rigid"
inertia = {{ zz = {I_l} }}
[[effect]]
name = "viscous_friction"
where = "joint_1"
[[sensor]]
channels = ["tau_1"]
noise = 1e-4
[[sensor]]
channels = ["theta_m_1", "q_1"]
noise = 1e-4
"""


def bench(factor: float = 1.0) -> System:
    """Its description, with nominal values that are the true ones times a factor."""
    values = {"I_m": I_M / GEAR**2, "I_l": I_L, "k": K, "b": B}
    return parse_system(TEXT.format(**{name: factor * value for name, value in values.items()}), "slow-encoder")


@cache
def _motion(coulomb: float, bearing: float) -> tuple[Array, Array]:
    def reference(t: float | Array) -> Array:
        return np.asarray(0.6 * np.sin(0.8 * np.pi * t) + 0.25 * np.sin(3.4 * np.pi * t + 1.0))

    def torque(t: float | Array, theta: Array, rate: Array) -> Array:
        return np.asarray(8.0 * (reference(t) - theta) - 0.3 * rate)

    def change(t: float, y: Array) -> list[float]:
        theta, q, rate, link_rate = y
        spring = K * (theta - q) + B * (rate - link_rate)
        rubbing = F * rate + coulomb * np.tanh(rate / 0.02)
        loaded = spring - bearing * np.tanh(link_rate / 0.02)
        return [rate, link_rate, (torque(t, theta, rate) - spring - rubbing) / I_M, loaded / I_L]

    t = np.arange(round(DURATION * RATE)) / RATE
    y = solve_ivp(change, (0.0, DURATION), np.zeros(4), t_eval=t, rtol=1e-9, atol=1e-11, method="LSODA").y
    return t, np.stack((torque(t, y[0], y[2]) / GEAR, y[0], y[1]), axis=1)


def session(
    corner: float | None,
    coulomb: float = 0.0,
    once: float = 0.0,
    seed: int = 0,
    wander: float = 0.0,
    bearing: float = 0.0,
) -> Block:
    """Samples; corner: Hz, of the low-pass behind which the link encoder is read; once: its error once per turn, rad.

    coulomb, bearing: friction of the motor, and of the link behind the spring, N m. wander: 1σ of the torque's gain,
    at random and correlated over a second.
    """
    t, exact = _motion(coulomb, bearing)
    values = exact.copy()
    if wander:
        fade, before = np.exp(-1.0 / RATE), round(10.0 * RATE)
        white = np.random.default_rng(1000 + seed).standard_normal(before + t.size)
        values[:, 0] *= 1.0 + wander * lfilter([np.sqrt(1.0 - fade**2)], [1.0, -fade], white)[before:]
    values[:, 2] += once * np.sin(values[:, 2] + 0.4)
    if corner is not None:
        values[:, 2] = lfilter(*butter(2, corner / (RATE / 2.0)), values[:, 2])
    values += NOISE * np.random.default_rng(seed).standard_normal(values.shape)
    return Block(t, ("tau_1", "theta_m_1", "q_1"), values)
