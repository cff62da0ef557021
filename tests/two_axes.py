"""A rigid planar arm of two axes with friction, in gravity, described as a person would."""

from __future__ import annotations

RATE, DURATION = 500.0, 24.0  # Hz, s
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
