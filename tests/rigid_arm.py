"""A rigid arm of three axes with gravity, whose last two cross as those of a wrist do."""

from __future__ import annotations

from sms_online.description.parse import parse_system
from sms_online.description.schema import Effect, System

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
