"""A bench of one flexible link whose markers read displacements alone: the smallest system that needs the smoother."""

from __future__ import annotations

from sms_online.description.parse import parse_system
from sms_online.description.schema import System

TEXT = """
name = "one-link"
motion = "planar"
sample_rate = 500.0

[joint_1]
gear_ratio = 50.0
stiffness = 400.0
damping = 10.0

[motor_1]
rotor_inertia = 0.002

[link_1]
kind = "flexible"
length = 1.0
elements = 2
mass_per_length = 3.0
flexural_rigidity_z = 60.0
deformations = ["bending_z"]
kinematics = "KINEMATICS"

[[sensor]]
channels = ["tau_1"]
noise = 0.004

[[sensor]]
channels = ["theta_m_1", "q_1"]
noise = 2e-5

[[sensor]]
channels = ["link_1.marker_*.u_y"]
rate = 125.0
noise = 1e-4

[controller]
stiffness = [60.0]
damping = [15.0]

[trajectory]
duration = 3.0
joint_1 = [{ frequency = 3.1, sine = 0.6 }, { frequency = 9.0, sine = 0.15 }]
"""


def one_link(kinematics: str, extra: str = "") -> System:
    """The bench with `linear` or `exact` link kinematics; extra: further tables of its description."""
    return parse_system(TEXT.replace("KINEMATICS", kinematics) + extra, "one-link")
