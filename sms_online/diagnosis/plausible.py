"""Which coefficients an effect can have at all: a fit that needs others is of something else."""

from __future__ import annotations

import numpy as np

from sms_online.stream import Array

# Effects that take power out, store it, have a mass or come too late: their coefficients are not negative.
POSITIVE = frozenset(
    (
        "air_drag", "backlash", "cable_spring", "coulomb_friction", "link_damping", "link_mass_damping",
        "load_friction", "sensor_lag", "slosh", "stribeck_friction", "tip_payload", "torque_delay",
        "torsional_hysteresis", "viscous_friction",
    )
)  # fmt: skip
# Largest coefficients. With a gain of -1 a measured torque explains itself and the arm weighs nothing; a channel that
# is later than half a window of the planar example, s, is no channel of this session.
LARGEST = {"torque_gain": 0.5, "torque_ripple": 0.5, "sensor_lag": 0.2, "torque_delay": 0.2}
# Smallest ones. Torque sensors, and models of what a torque moves, are right to a thousandth at best: a gain or ripple
# below that is no fault of theirs. A delay of less than a microsecond is none.
SMALLEST = {"torque_gain": 1e-3, "torque_ripple": 1e-3, "torque_delay": 1e-6}

# A drive that holds its command over a sample acts half a sample late: a lag up to that, in samples, is no sensor's.
HELD = 0.5


def plausible(name: str, coefficients: Array, sample_rate: float) -> bool:
    """Whether an effect can have these linear coefficients (c,) on samples at so many Hz."""
    if name in POSITIVE and np.any(coefficients < 0.0):
        return False
    if name == "sensor_lag" and coefficients[0] <= HELD / sample_rate:
        return False
    return bool(SMALLEST.get(name, 0.0) <= np.linalg.norm(coefficients) <= LARGEST.get(name, np.inf))
