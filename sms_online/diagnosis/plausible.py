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
# Ratios whose size is below this: with -1 a measured torque explains itself and the arm weighs nothing.
RATIOS = frozenset(("torque_gain", "torque_ripple"))
LARGEST_RATIO = 0.5


def plausible(name: str, coefficients: Array) -> bool:
    """Whether an effect can have these linear coefficients (c,)."""
    if name in POSITIVE:
        return bool(np.all(coefficients >= 0.0))
    if name in RATIOS:
        return bool(np.linalg.norm(coefficients) <= LARGEST_RATIO)
    return True
