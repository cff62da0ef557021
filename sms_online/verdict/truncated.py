"""Links that have fewer elements than a motion needs: what that would move parameters by, were it not corrected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sms_online.calibration.found import CERTAIN
from sms_online.calibration.truncation import FINER
from sms_online.description.bodies import FlexibleLink
from sms_online.verdict.trust import Reason

if TYPE_CHECKING:
    from sms_online.evaluation import Evaluation

# A correction of first order leaves its square: of a tenth one per cent, which no error bar counts.
FIRST_ORDER = 0.1


@dataclass(frozen=True)
class Truncated:
    """A link whose elements are too few for a motion.

    where: `link_i`. elements: as described. parameter: the one that is corrected by most of its error bars. share: of
    its value, that it would be off by; deviations: the same in its standard deviations.
    """

    where: str
    elements: int
    parameter: str
    share: float
    deviations: float

    def __str__(self) -> str:
        return (
            f"{self.where}: {self.elements} elements are too few for this motion: without a correction of first order "
            f"{self.parameter} would be {100.0 * self.share:+.2g} % off, {self.deviations:.2g} standard deviations"
        )

    @property
    def advice(self) -> str:
        """What to do where a correction of first order is not enough."""
        return f"describe {self.where} with elements = {FINER * self.elements}; its markers stay where they are"

    @property
    def reason(self) -> Reason:
        """Why to doubt the numbers, where a correction of first order is not enough."""
        text = f"{self.where}: {self.elements} elements are too few: {100.0 * self.share:+.2g} % of {self.parameter}"
        return Reason(text, False, (self.where,), "too few elements", f"{self}: {self.advice}", self.advice)


def truncated(evaluation: Evaluation) -> list[Truncated]:
    """Of each link whose truncation is certain and moves a determined parameter by more than its error bar."""
    estimate, nuisances = evaluation.estimate, evaluation.statistics.setup.nuisances
    known = np.flatnonzero(evaluation.determined)
    if estimate.crossed is None or estimate.nuisances.size != len(nuisances) or not known.size:
        return []
    out = []
    for k, nuisance in enumerate(nuisances):
        value, std = float(estimate.nuisances[k]), float(estimate.nuisances_std[k])
        if nuisance.name != "truncation" or not abs(value) > CERTAIN * std:
            continue
        # The estimate with the nuisance held at zero, less that with what rows say of it.
        off = -estimate.crossed[k, known] * value / std**2
        deviations = np.abs(off) / evaluation.std[known]
        worst = int(np.argmax(deviations))
        if deviations[worst] > 1.0:
            link = evaluation.model.system.links[int(nuisance.where.removeprefix("link_")) - 1]
            assert isinstance(link, FlexibleLink)
            share = float(off[worst] / abs(estimate.pi[known[worst]]))
            name = evaluation.parameters[known[worst]].name
            out.append(Truncated(nuisance.where, link.elements, name, share, float(deviations[worst])))
    return out
