"""What a gear and its spring do beyond k δ, δ = θ_m - q: torques between motor and link side alone.

Sources: hysteresis: Dahl, AIAA J. 14 (1976) 1675, of a spring; cubic stiffness and kinematic error of harmonic drives:
Tuttle, Seering, IEEE Trans. Robotics and Automation 12 (1996) 368; backlash: Nordin, Gutman, Automatica 38 (2002) 1633.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sms_online.effects.base import Entry, Shape, Site, deflection, position, shares_of
from sms_online.effects.friction import DahlFriction, MotorSide
from sms_online.effects.harmonic import amplitude_and_phase, nominal_parts, phase_columns
from sms_online.effects.traits import Curve, Traits
from sms_online.model.effect import Inputs
from sms_online.model.layout import Layout
from sms_online.stream import Array

# Gears are true to arc minutes; 0.1 rad would be seen by eye.
LARGEST_ERROR = 0.1
# Widths of gaps and of hysteresis to try.
WIDTHS = shares_of("deflection", 0.01, 0.03, 0.1, 0.3)


class Transmission(MotorSide):
    """A generalized force pair along δ: what `along` gives acts on θ_m, and its opposite on q."""

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """`along` on the row of θ_m, its opposite on that of q."""
        f = super().force(layout, x, v, inputs)
        f[:, layout.q[self.index - 1]] = -f[:, self.axis(layout)]
        return f

    def rate(self, layout: Layout, v: Array) -> Array:
        """δ̇ (B,)."""
        return v[:, layout.theta_m[self.index - 1]] - v[:, layout.q[self.index - 1]]


class TorsionalHysteresis(Transmission, DahlFriction):
    """f = -c z / δ_s along δ with ż = δ̇ - |δ̇| z / δ_s: the spring's torque depends on where it comes from.

    c: `torque` that it saturates at, N m. δ_s: shape constant `width`, rad. The internal state z starts at 0.
    Limitations: rate-independent; its energy per cycle does not depend on the load.
    """

    entry = Entry(
        "torsional_hysteresis", "force", "flexible joint", {"torque": "N m"},
        "slow load cycles of two amplitudes: damping fades with speed, hysteresis does not",
        {"width": Shape("rad", 0.01, WIDTHS)},
    )  # fmt: skip
    symbols = ("h_{}",)


class CubicStiffness(Transmission):
    """f = -c δ³ along δ, c `stiffness` in N m/rad³: a spring that hardens (c > 0) or softens.

    Limitations: odd and smooth; a harmonic drive's soft zone around zero asks for more.
    """

    entry = Entry(
        "cubic_stiffness", "force", "flexible joint", {"stiffness": "N m/rad³"}, "small and large deflections",
        traits=Traits(signed=True, curve=Curve("deflection", between=True)),
    )  # fmt: skip

    symbols = ("k_3{}",)

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """-δ³."""
        return -(deflection(layout, x, self.index - 1) ** 3)[:, None]


class Backlash(Transmission):
    """The spring acts beyond a dead zone of ± gap: f = +k clip(δ, -gap, gap) along δ on top of the linear spring.

    k: `stiffness` that is lost inside the gap, N m/rad, that of the joint unless stated. gap: shape constant, half
    width, rad.
    Limitations: no impact losses; the damper acts inside the gap too.
    """

    entry = Entry(
        "backlash", "force", "flexible joint", {"gap": "rad"}, "deflections within and far beyond the gap",
        {"gap": Shape("rad", 0.001, WIDTHS)}, {"stiffness": "N m/rad"},
        Traits(curve=Curve("deflection", between=True)),
    )  # fmt: skip

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        nominal = given.get("stiffness", site.system.joints[site.index - 1].stiffness)
        super().__init__(site, given, {"stiffness": (f"k_g{site.index}", "N m/rad", nominal)})
        if "stiffness" not in given:
            self.relative_to = (f"joint_{site.index}.stiffness",)

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """clip(δ, -gap, gap)."""
        gap = self.shapes["gap"]
        return np.clip(deflection(layout, x, self.index - 1), -gap, gap)[:, None]

    def reported(self, values: Array) -> dict[str, float]:
        """The gap where all of the joint's stiffness k is lost inside: that spring gives k gap less beyond it.

        Where another stiffness is stated, the one that it is for.
        """
        lost = values[0] / values[1] if self.relative_to else 1.0
        return {"gap": float(self.shapes["gap"] * lost)}


class KinematicError(Transmission):
    """f = -k e - b ė along δ, e = a cos(p n θ_m - φ) rad: the gear's output is off by e, `order` p = 2 times a turn.

    a: `amplitude`, rad; φ: `phase`, rad; linear in π are k a cos φ and k a sin φ, N m.
    Limitations: b / k is that of the description. The torque -e' (k δ + b δ̇), e' = de/dθ_m, by which the spring drives
    the motor back, is left out, for it holds the deflection, which late encoders falsify: it looks like a torque ripple
    of the same order, of the amplitude a p n.
    """

    entry = Entry(
        "kinematic_error", "force", "flexible joint", {"amplitude": "rad", "phase": "rad"},
        "constant speeds that put the error's frequency below and above the joint's resonance",
        {"order": Shape("", 2.0, lambda ranges: (1.0, 2.0, 4.0), counted=True)},
        traits=Traits(
            signed=True,
            curve=Curve("phase in the motor's turn", between=True),
            limits={"amplitude": (0.0, LARGEST_ERROR)},
        ),
    )  # fmt: skip

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        linear = nominal_parts("e", site.index, "N m", given, site.system.joints[site.index - 1].stiffness)
        super().__init__(site, given, linear)
        joint = site.system.joints[site.index - 1]
        self._turns = site.gear_ratio
        self._damping = joint.damping / joint.stiffness if joint.stiffness else 0.0  # b / k, s
        self.relative_to = (f"joint_{site.index}.stiffness",)

    def along(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """-(e + b/k ė) of unit amplitudes of cosine and sine."""
        turns = self.shapes["order"] * self._turns
        e = phase_columns(turns * position(layout, x, layout.theta_m[self.index - 1]))
        slope = turns * np.stack((-e[:, 1], e[:, 0]), axis=1)
        return -(e + self._damping * slope * v[:, layout.theta_m[self.index - 1], None])

    def reported(self, values: Array) -> dict[str, float]:
        """a and φ, for the stiffness k of the estimate."""
        with np.errstate(divide="ignore", invalid="ignore"):  # where the estimate has no spring
            return amplitude_and_phase(values[:2] / values[2]) | dict(self.shapes)
