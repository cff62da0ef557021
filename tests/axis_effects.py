"""The axis with effects that its description lacks, some of which begin in the middle of a session."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sms_online.description.parse import parse_system
from sms_online.stream import Array, Block
from tests.axis import AXIS, DAMPING, INERTIA

RATE = 200.0  # Hz
SYSTEM = parse_system(AXIS, "axis.toml")
# The same, friction not described.
BARE = parse_system(AXIS[: AXIS.index("[[effect]]")], "bare.toml")
COGGING, PHASE, ORDER = 0.2, 0.5, 6  # N m, rad, periods a turn

# Torque that the motor has to give beside the model's, of angle and rate.
Force = Callable[[Array, Array], Array]


def nothing(q: Array, rate: Array) -> Array:
    """The model is right."""
    return 0.0 * q


def cogging(q: Array, rate: Array) -> Array:
    """-a cos(p θ - φ), which the effect adds, has to be overcome."""
    return -COGGING * np.cos(ORDER * q - PHASE)


def axis_block(force: Force, begin: float = 0.0, seconds: float = 16.0, seed: int = 5) -> Block:
    """An axis whose motor is measured to 0.01 N m and its angle to 1e-4 rad; an effect acts from `begin`, s, on."""
    t = np.arange(round(seconds * RATE)) / RATE
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    rate, acceleration = 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t), -4 * np.sin(2 * t) - 7.5 * np.sin(5 * t)
    torque = INERTIA * acceleration + DAMPING * rate + np.where(t >= begin, force(q, rate), 0.0)
    noise = np.random.default_rng(seed).standard_normal((t.size, 2)) * [0.01, 1e-4]
    return Block(t, ("force_1", "q_1"), np.stack((torque, q), axis=1) + noise)
