"""A mass at the tip that the description does not hold."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sms_online.effects.base import Entry, Site
from sms_online.model.parameters import Parameter
from sms_online.stream import Array


class TipPayload:
    """A point mass at the tip, `mass` in kg, and where it is stated its `inertia` about the tip, kg m², in every axis.

    Its columns are those of a body in the tip's frame. A whole body with its centre elsewhere is a [payload].
    Limitations: rigid, centred in the tip; in space its inertia is the same about every axis.
    """

    entry = Entry(
        "tip_payload", "inertia", "tip", {"mass": "kg", "inertia": "kg m²"},
        "motion of the last joint alone, fast: a heavier link has its centre elsewhere",
    )  # fmt: skip

    def __init__(self, site: Site, given: Mapping[str, float]) -> None:
        self.name, self.where = self.entry.name, site.where
        self.frame, self.speeds = site.chain.tip_frame, slice(0, 0)
        owner = f"{self.name}@{self.where}"
        self.parameters: tuple[Parameter, ...] = (Parameter(f"{owner}.mass", "m_p", "kg", given.get("mass", 0.0)),)
        self.matrices: Array = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])[None]
        if "inertia" in given:
            self.parameters += (Parameter(f"{owner}.inertia", "I_p", "kg m²", given["inertia"]),)
            self.matrices = np.stack((self.matrices[0], np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])))

    def reported(self, values: Array) -> dict[str, float]:
        """The parameters as they are."""
        return {p.quantity: float(value) for p, value in zip(self.parameters, values, strict=True)}
