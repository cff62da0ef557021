"""Damping of flexible links. Source: Clough, Penzien, Dynamics of Structures, 2nd ed. 1993, section 12.5."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sms_online.effects.base import Entry, Force, Site
from sms_online.model.effect import Inputs
from sms_online.model.flexible import LinkKinematics
from sms_online.model.layout import Layout
from sms_online.model.parameters import rigidity_parameter
from sms_online.stream import Array

SEPARATED_BY = "vibration in two modes: damping by stiffness grows with frequency, by mass it does not"


class LinkForce(Force):
    """A generalized force on the elastic coordinates of one link."""

    def __init__(
        self, site: Site, given: Mapping[str, float], linear: Mapping[str, tuple[str, str, float]] | None = None
    ) -> None:
        super().__init__(site, given, linear)
        kinematics = site.chain.flexible[site.index - 1]
        assert kinematics is not None
        self.kinematics: LinkKinematics = kinematics
        self.chain = site.chain


class LinkDamping(LinkForce):
    """f = -η K_f q̇_f (Kelvin–Voigt), η: `time`, s: stress follows strain and its rate.

    Linear in π is η times each rigidity, a viscosity in N m² s (N s for traction), one a rigidity of the link; each is
    reported as a time of its own where there are several.
    Limitations: real materials lose about as much a cycle at any frequency, so η fits one mode.
    """

    entry = Entry("link_damping", "force", "link", {"time": "s"}, SEPARATED_BY)

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        i, planar = site.index, site.chain.layout.planar
        link = site.system.links[i - 1]
        assert link.kind == "flexible"
        kinematics = site.chain.flexible[i - 1]
        assert kinematics is not None
        rigidities = [rigidity_parameter(i, name, link, planar) for name in kinematics.stiffness]
        linear = {
            p.quantity.replace("rigidity", "viscosity"): (
                f"η {p.symbol}", f"{p.unit} s", given.get("time", 0.0) * p.nominal,
            )
            for p in rigidities
        }  # fmt: skip
        super().__init__(site, given, linear)
        self.relative_to = tuple(p.name for p in rigidities)

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """-K q̇_f on the link's rows, K that of one unit of each rigidity."""
        f = np.zeros((*v.shape, len(self.parameters)))
        rows = layout.q_f[self.index - 1]
        for k, K in enumerate(self.kinematics.stiffness.values()):
            f[:, rows, k] = -v[:, rows] @ K
        return f

    def reported(self, values: Array) -> dict[str, float]:
        """η = viscosity / rigidity, as `time`, or as `time_<rigidity>` where there are several."""
        n = len(self.parameters)
        times = (values[:n] / values[n:]).tolist()
        if n == 1:
            return {"time": times[0]}
        return {f"time_{name.rsplit('.', 1)[1]}": time for name, time in zip(self.relative_to, times, strict=True)}


class LinkMassDamping(LinkForce):
    """f = -c M_f q̇_f, c: `rate`, 1/s: drag on a link in proportion to its mass (air, cables along it).

    M_f: mass matrix of the elastic coordinates in the link's own frame. Linear in π is c ρA, `drag_per_length`, N s/m².
    Limitations: only motion relative to the link's frame is damped; rotary inertia of torsion is left out.
    """

    entry = Entry("link_mass_damping", "force", "link", {"rate": "1/s"}, SEPARATED_BY)

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        link = site.system.links[site.index - 1]
        assert link.kind == "flexible"
        nominal = given.get("rate", 0.0) * link.mass_per_length
        super().__init__(site, given, {"drag_per_length": (f"c ρA_{site.index}", "N s/m²", nominal)})
        self.relative_to = (f"link_{site.index}.mass_per_length",)

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """-∫ Jᵀ J ds q̇_f on the link's rows."""
        f = np.zeros((*v.shape, 1))
        rows = layout.q_f[self.index - 1]
        J = self.kinematics.shape(self.chain.elastic(x, self.index - 1)).J
        velocity = (J @ v[:, None, rows, None])[..., 0]  # (B, G, 3)
        weighted = velocity * self.kinematics.weights[:, None]
        f[:, rows, 0] = -np.einsum("bgin,bgi->bn", np.broadcast_to(J, (len(v), *J.shape[1:])), weighted)
        return f

    def reported(self, values: Array) -> dict[str, float]:
        """c = c ρA / ρA."""
        return {"rate": float(values[0] / values[1])}
