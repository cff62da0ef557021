"""What couples two axes, and a spring that carries an axis's weight.

Source of coupled wrists: Gautier, Vandanjon, Presse, IFAC Symp. System Identification (1994) 1181, whose motor of the
last axis turns with the sum of the last two; of springs that carry weight: Dombre, Khalil, Modeling, Identification
and Control of Robots, 2002, section 9.2.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sms_online.effects.base import Entry, Force, Site, joints_of, position
from sms_online.effects.friction import sign
from sms_online.effects.harmonic import amplitude_and_phase, nominal_parts, phase_columns
from sms_online.effects.traits import Traits
from sms_online.model.effect import Inputs
from sms_online.model.layout import Layout
from sms_online.model.parameters import Parameter
from sms_online.stream import Array

BOTH_APART = "each of the two axes moved alone, and both at once"


class CoupledFriction(Force):
    """f = -c sign(r) - d r on both of two axes, r = θ̇_m,i + θ̇_m,j: friction of a shaft that turns with their sum.

    c: `torque`, N m; d: `damping`, N m s/rad, both at the output side.
    Limitations: the sum alone; a shaft that turns with the difference is one whose second axis points the other way.
    """

    entry = Entry(
        "coupled_friction", "force", "joint pair", {"torque": "N m", "damping": "N m s/rad"}, BOTH_APART,
    )  # fmt: skip
    symbols = ("c_{}", "d_{}")

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """The same on the rows of both motors."""
        motors = [layout.theta_m[i] for i in joints_of(self.where)]
        rate = v[:, motors].sum(axis=1)
        f = np.zeros((*v.shape, 2))
        f[:, motors] = -np.stack((sign(rate), rate), axis=1)[:, None]
        return f


class CoupledInertia:
    """½ J (θ̇_m,i + θ̇_m,j)²: `inertia` J, kg m² at the output side, of a shaft that turns with the sum of two axes."""

    entry = Entry("coupled_inertia", "inertia", "joint pair", {"inertia": "kg m²"}, BOTH_APART)

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        self.name, self.where, self.frame = self.entry.name, site.where, 0
        first, second = sorted(site.chain.layout.theta_m[i] for i in joints_of(site.where))
        self.speeds = slice(first, second + 1, second - first)
        mark = site.where.replace("joint_", "")
        owner = f"{self.name}@{self.where}.inertia"
        self.parameters: tuple[Parameter, ...] = (Parameter(owner, f"J_{mark}", "kg m²", given.get("inertia", 0.0)),)
        self.matrices: Array = np.zeros((1, 8, 8))
        self.matrices[0, 6:, 6:] = 1.0

    def reported(self, values: Array) -> dict[str, float]:
        """The inertia as it is."""
        return {"inertia": float(values[0])}


class GravitySpring(Force):
    """f = -a cos(q - φ) on q: a spring or a counterweight that carries an axis's weight, whatever the axes before do.

    a: `amplitude`, N m; φ: `phase`, rad; linear in π are a cos φ and a sin φ. Of a spring between two points that are
    not on the axis it is exact where its length without load is zero.
    Limitations: a spring with a length of its own, or of gas, is not quite a cosine.
    """

    entry = Entry(
        "gravity_spring", "force", "weighed joint", {"amplitude": "N m", "phase": "rad"},
        "the same angles of the axis with the axes after it stretched and folded",
        traits=Traits(signed=True),
    )  # fmt: skip

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        super().__init__(site, given, nominal_parts("g", site.index, "N m", given))

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """-cos and -sin of q."""
        link = layout.q[self.index - 1]
        f = np.zeros((*v.shape, 2))
        f[:, link] = -phase_columns(position(layout, x, link))
        return f

    def reported(self, values: Array) -> dict[str, float]:
        """a and φ."""
        return amplitude_and_phase(values)
