"""Torque of a motor and its measurement: cogging, ripple, offset, gain; a delay is one of the channel.

Source: Holtz, Springob, IEEE Trans. Industrial Electronics 43 (1996) 309 (cogging and ripple of servo motors).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sms_online.effects.base import Entry, Shape, Site, beyond_zero, position
from sms_online.effects.friction import MotorSide
from sms_online.effects.harmonic import amplitude_and_phase, nominal_parts, phase_columns
from sms_online.effects.traits import Curve, Traits
from sms_online.model.effect import Inputs
from sms_online.model.layout import Layout
from sms_online.stream import Array

# Torque sensors, and models of what a torque moves, are right to a thousandth at best: a gain or ripple below that is
# no fault of theirs. With a gain of -1 a measured torque explains itself and the arm has no mass.
LEAST_RATIO, LARGEST_RATIO = 1e-3, 0.5
# Torque constants of two drives differ by a tenth or two; more is a mistake of unit or gear, or not of the drive.
LARGEST_GAIN = 0.3
# Orders that windings and poles of usual motors give, per motor turn.
ORDERS = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 18.0, 24.0)


class Cogging(MotorSide):
    """f = a cos(p n θ_m - φ): torque of magnets against teeth, `order` p times a motor turn, after the gear.

    a: `amplitude`, N m; φ: `phase`, rad; linear in π are a cos φ and a sin φ.
    Limitations: one order; independent of the current.
    """

    entry = Entry(
        "cogging", "force", "driven joint", {"amplitude": "N m", "phase": "rad"},
        "many motor turns, under little and much torque (ripple grows with it)",
        {"order": Shape("", 6.0, lambda ranges: ORDERS, counted=True)},
        traits=Traits(signed=True, curve=Curve("phase in the motor's turn")),
    )  # fmt: skip
    symbol, unit = "g", "N m"

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        super().__init__(site, given, nominal_parts(self.symbol, site.index, self.unit, given))
        self.gear_ratio = site.gear_ratio

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """cos and sin of p n θ_m."""
        theta_m = position(layout, x, layout.theta_m[self.index - 1])
        return phase_columns(self.shapes["order"] * self.gear_ratio * theta_m)

    def reported(self, values: Array) -> dict[str, float]:
        """a and φ."""
        return amplitude_and_phase(values) | dict(self.shapes)


class TorqueRipple(Cogging):
    """f = a n τ cos(p n θ_m - φ): the torque constant varies with the rotor's angle, `order` p times a motor turn.

    a: `amplitude`, a ratio; φ: `phase`, rad; linear in π are a cos φ and a sin φ.
    Limitations: one order.
    """

    entry = Entry(
        "torque_ripple", "force", "driven joint", {"amplitude": "", "phase": "rad"},
        "many motor turns, under little and much torque (cogging does not grow with it)",
        {"order": Shape("", 6.0, lambda ranges: ORDERS, counted=True)},
        traits=Traits(signed=True, least=LEAST_RATIO, most=LARGEST_RATIO),
    )  # fmt: skip
    symbol, unit = "w", ""
    needs_torque = True

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """n τ times cos and sin of p n θ_m."""
        assert inputs is not None
        return np.asarray(inputs.torque[:, self.index - 1, None] * super().along(layout, x, v, inputs))


class TorqueOffset(MotorSide):
    """The measured torque reads c too much at the motor shaft (N m; N on a direct drive), so the arm feels -n c.

    Coulomb friction that differs by direction is symmetric friction and such an offset.
    Limitations: constant over the session; a drifting amplifier needs a slower model.
    """

    entry = Entry(
        "torque_offset", "force", "driven joint", {"torque": "N m"}, "standstill under a known torque",
        traits=Traits(signed=True, curve=Curve("motor speed"), begins=True, calibrates=("drive_offset",)),
        said=lambda where, given: (
            f"the torque of {where} reads {beyond_zero(given['torque'])} at the shaft, or its Coulomb friction differs "
            "by direction: no motion distinguishes them, look at what it reads at rest without load"
        ),
    )  # fmt: skip

    symbols = ("o_{}",)

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        super().__init__(site, given)
        self.gear_ratio = site.gear_ratio

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """-n."""
        return np.full((v.shape[0], 1), -self.gear_ratio)


def _gain_in_words(where: str, given: Mapping[str, float]) -> str:
    ratio = given["ratio"]
    return f"{where}'s torque reads {100.0 * abs(ratio):.2g} % {'low' if ratio > 0.0 else 'high'}"


class TorqueGain(MotorSide):
    """The arm feels (1 + g) n τ where n τ is measured; g: `ratio`.

    Limitations: a gain common to all joints only rescales π, so it is relative to joint 1, which has none. Where a
    parameter is known, the gains of all joints are matters of calibration.
    """

    entry = Entry(
        "torque_gain", "force", "later joint", {"ratio": ""}, "motion of each joint alone, then of all",
        traits=Traits(
            signed=True, least=LEAST_RATIO, most=LARGEST_GAIN, curve=Curve("torque"), calibrates=("drive_gain",)
        ),
        relative_to="joint_1", said=_gain_in_words,
    )  # fmt: skip
    symbols = ("g_{}",)
    needs_torque = True

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """n τ."""
        assert inputs is not None
        return inputs.torque[:, self.index - 1, None]
