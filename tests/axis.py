"""A single rigid axis with viscous friction, described and measured by hand, for tests that need a session fast."""

from __future__ import annotations

import numpy as np

from sms_online.stream import Block

INERTIA, DAMPING = 0.3, 0.1  # kg m², N m s/rad
AXIS = f"""
name = "axis"
motion = "planar"
sample_rate = 200.0
[joint_1]
transmission = "rigid"
[link_1]
kind = "rigid"
inertia = {{ zz = {INERTIA} }}
[[effect]]
name = "viscous_friction"
where = "joint_1"
coefficients = {{ damping = {DAMPING} }}
"""
# What moves it in simulation.
MOTION = """
[controller]
stiffness = [40.0]
damping = [8.0]
[trajectory]
duration = 6.0
joint_1 = [{ frequency = 2.0, sine = 1.0 }, { frequency = 5.0, cosine = 0.3 }]
"""


def capture_lines(seconds: float = 6.0) -> list[str]:
    """An axis that is moved: header and 200 rows a second, the torque by inverse dynamics."""
    t = np.arange(round(200 * seconds)) / 200.0
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    rate, acceleration = 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t), -4 * np.sin(2 * t) - 7.5 * np.sin(5 * t)
    torque = INERTIA * acceleration + DAMPING * rate
    return ["t,force_1,q_1", *(f"{a},{b},{c}" for a, b, c in zip(t.tolist(), torque.tolist(), q.tolist(), strict=True))]


def axis_block(coulomb: float) -> Block:
    """The axis along two sines, with friction that its description lacks, sensors' noise of seed 3."""
    t = np.arange(2400) / 200.0
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    rate, acceleration = 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t), -4 * np.sin(2 * t) - 7.5 * np.sin(5 * t)
    torque = INERTIA * acceleration + DAMPING * rate + coulomb * np.sign(rate)
    noise = np.random.default_rng(3).standard_normal((2, t.size)) * ((0.01,), (1e-4,))
    return Block(t, ("force_1", "q_1"), np.stack((torque, q), axis=1) + noise.T)
