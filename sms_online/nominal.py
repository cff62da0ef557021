"""How an estimate compares with the values that the system file states for it.

A wrong unit, gear or sign scales the whole balance, so the rows fit and nothing but the stated values shows it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.description.bodies import Joint
from sms_online.description.schema import System
from sms_online.stream import Array

# Nominal values of a rig are right to within this factor, all of them together, and each to within the other.
LARGEST_COMMON_FACTOR = 1.5
LARGEST_FACTOR = 2.0
# A factor is common where this share of the parameters, and at least so many, have it within this ratio.
COMMON_SHARE = 2.0 / 3.0
LEAST_COMMON = 2
SAME_FACTOR = 1.25
# A factor is that of a unit or a gear where it is within this ratio of it.
SAME_UNIT = 1.15


@dataclass(frozen=True)
class Apart:
    """A parameter whose estimate is not what the system file states: name, estimate and nominal value, SI."""

    name: str
    value: float
    nominal: float


@dataclass(frozen=True)
class NominalComparison:
    """An estimate against nominal values.

    common: factor by which nearly all parameters exceed their nominal values, None where there is none beyond
    LARGEST_COMMON_FACTOR. cause: what that factor looks like, empty where it is that of no unit or gear. apart:
    parameters that differ from their nominal values by more than LARGEST_FACTOR, with 95 % certainty, on their own.
    """

    common: float | None = None
    cause: str = ""
    apart: tuple[Apart, ...] = ()


AS_STATED = NominalComparison()


def compare(
    names: Sequence[str], value: Array, std: Array, nominal: Mapping[str, float], factors: Mapping[str, float]
) -> NominalComparison:
    """Compare estimates `value` ± `std` (n,), of determined parameters alone, with nominal values by name.

    factors: what units and gears would make of all values, by what each looks like, see `unit_factors`.
    """
    stated = [k for k, name in enumerate(names) if nominal.get(name)]
    if not stated:
        return AS_STATED
    described = np.array([nominal[names[k]] for k in stated])
    ratio = value[stated] / described
    sign = 1.0 if np.count_nonzero(ratio > 0.0) >= len(stated) / 2 else -1.0
    same = sign * ratio > 0.0
    logarithm = np.log(np.where(same, np.abs(ratio), 1.0))
    middle = float(np.median(logarithm[same]))
    near = same & (np.abs(logarithm - middle) < math.log(SAME_FACTOR))
    common = np.count_nonzero(near) >= max(LEAST_COMMON, COMMON_SHARE * len(stated))
    if common and (sign < 0.0 or abs(middle) > math.log(LARGEST_COMMON_FACTOR)):
        factor = sign * math.exp(middle)
        causes = [each for each, size in factors.items() if 1.0 / SAME_UNIT < factor / size < SAME_UNIT]
        return NominalComparison(factor, causes[0] if causes else "")
    # The end of the 95 % interval that is nearer to the nominal value.
    nearer = value[stated] - np.clip(value[stated] - described, -2.0 * std[stated], 2.0 * std[stated])
    share = nearer / described
    beyond = (share > LARGEST_FACTOR) | (share < 1.0 / LARGEST_FACTOR)
    return NominalComparison(
        apart=tuple(Apart(names[k], float(value[k]), nominal[names[k]]) for k in np.array(stated)[beyond].tolist())
    )


def unit_factors(system: System) -> dict[str, float]:
    """Factors by which common mistakes multiply all parameters, by what the samples look like then."""
    drive, unit = ("torque", "N m") if any(is_geared(joint) for joint in system.joints) else ("force", "N")
    out = {
        f"the {drive} looks like m{unit} in place of {unit}": 1e3,
        f"the {drive} looks like k{unit} in place of {unit}": 1e-3,
        "the angles look like degrees": math.pi / 180.0,
        f"the sign of the {drive} looks inverted": -1.0,
    }
    gears = {joint.gear_ratio for joint in system.joints if is_geared(joint)}
    if len(gears) == 1:
        (gear,) = gears
        out["tau_i looks like the joint's torque in place of the motor shaft's"] = gear
        out["tau_i looks divided by the gear ratio twice"] = 1.0 / gear
    return out


def is_geared(joint: Joint) -> bool:
    """Whether the drive's torque is measured before a gear."""
    return joint.kind == "revolute" and joint.gear_ratio != 1.0
