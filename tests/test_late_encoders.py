"""All encoders of a rigid arm come late behind its torques, with friction that the description lacks beside it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

import sms_online as sms
from sms_online.description.parse import parse_system
from sms_online.effects.build import declaring
from sms_online.effects.catalogue import parse_effect
from sms_online.stream import Block

RATE, DURATION = 500.0, 24.0  # Hz, s
LATE = 0.006  # s
JOINT = """
[joint_{i}]
gear_ratio = 100.0
transmission = "rigid"
[motor_{i}]
rotor_inertia = {rotor}
[link_{i}]
kind = "rigid"
mass = {mass}
center_of_mass = [0.2, 0.0, 0.0]
inertia = {{ zz = {inertia} }}
tip = [0.4, 0.0, 0.0]
[[effect]]
name = "coulomb_friction"
where = "joint_{i}"
coefficients = {{ torque = {coulomb} }}
[[effect]]
name = "viscous_friction"
where = "joint_{i}"
coefficients = {{ damping = {viscous} }}
"""
TEXT = f"""
name = "two rigid axes"
motion = "planar"
sample_rate = {RATE}
gravity = [0.0, -9.81, 0.0]
{JOINT.format(i=1, rotor=1e-4, mass=6.0, inertia=0.2, coulomb=6.0, viscous=5.0)}
{JOINT.format(i=2, rotor=5e-5, mass=3.0, inertia=0.1, coulomb=3.0, viscous=2.0)}
[[sensor]]
channels = ["tau_1", "tau_2"]
noise = 0.004
[[sensor]]
channels = ["q_1"]
noise = 5e-6
[[sensor]]
channels = ["q_2"]
noise = 5e-6
[controller]
stiffness = [8000.0, 3000.0]
damping = [400.0, 150.0]
[trajectory]
duration = {DURATION}
joint_1 = [{{ frequency = 1.3, sine = 0.5 }}, {{ frequency = 5.1, sine = 0.15 }}, {{ frequency = 11.0, sine = 0.03 }}]
joint_2 = [{{ frequency = 1.9, sine = 0.6 }}, {{ frequency = 6.7, sine = 0.12 }}, {{ frequency = 13.0, sine = 0.03 }}]
"""


@pytest.mark.slow
@pytest.mark.parametrize("late", [0.0, LATE])
def test_a_latency_of_all_encoders_is_named(late: float) -> None:
    system = parse_system(TEXT, "test")
    lacking = declaring(system, [parse_effect("stribeck_friction@joint_1:torque=2,velocity=0.1", system)])
    capture = sms.simulate(lacking, DURATION, seed=1)
    values = capture.values.copy()
    encoders = [capture.channels.index(name) for name in ("q_1", "q_2")]
    values[:, encoders] = make_interp_spline(capture.t, values[:, encoders], 3)(capture.t - late)
    found = sms.diagnose(system, [Block(capture.t, capture.channels, values)])
    lags = [effect for effect in found.system.effects if effect.name == "sensor_lag"]
    assert [effect.where for effect in lags] == (["q_*"] if late else [])
    assert "stribeck_friction@joint_1" in [effect.key for effect in found.system.effects]
    for effect in lags:
        delay = np.sqrt(2.0) / (2.0 * np.pi * effect.coefficients["corner"])
        assert delay == pytest.approx(late, rel=0.1)
