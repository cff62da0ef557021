"""Links that have fewer elements than a motion needs, and what their correction moves parameters by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_online.calibration.found import CERTAIN
from sms_online.calibration.truncation import FINER
from sms_online.description.bodies import FlexibleLink
from sms_online.description.tree import index_of
from sms_online.evaluation import Evaluation
from sms_online.verdict.trust import Reason

# Share from which on a link is rather a continuous one than one of its elements.
CONTINUOUS = 0.5
# A correction that moves no parameter by so much of what rows leave unknown of it is not worth a word.
LEAST = 0.5
# A correction of first order leaves its square: of a tenth one per cent, which no error bar counts.
FIRST_ORDER = 0.1


@dataclass(frozen=True)
class Truncated:
    """A link whose elements are too few for a motion.

    where: `link_i`. elements: as described. amount, std: share, of what more elements change, that rows ask for.
    parameter: the one that this moves by most of its standard deviations, by the rows; share: of its value; deviations:
    in these.
    """

    where: str
    elements: int
    amount: float
    std: float
    parameter: str
    share: float
    deviations: float

    def __str__(self) -> str:
        return (
            f"{self.where}: {self.elements} elements are too few for this motion: rows are corrected to first order by "
            f"{100.0 * self.amount:.0f} ± {100.0 * self.std:.0f} % of what {FINER * self.elements} would change, which "
            f"moves {self.parameter} by {self._moved}, {self.deviations:.2g} standard deviations"
        )

    @property
    def _moved(self) -> str:
        return f"{100.0 * self.share:+.2g} %"

    @property
    def advice(self) -> str:
        """What to do where a correction of first order is not enough: the smoother knows the shape between markers."""
        return f"describe {self.where} with elements = {FINER * self.elements}; its markers stay where they are"

    @property
    def reason(self) -> Reason:
        """Why to doubt the numbers, where a correction of first order is not enough."""
        text = f"{self.where}: {self.elements} elements are too few: {self.parameter} moves by {self._moved}"
        return Reason(text, False, (self.where,), "too few elements", f"{self}: {self.advice}", self.advice)


def truncated(evaluation: Evaluation) -> list[Truncated]:
    """Of each link that is rather a continuous one, where that moves a determined parameter by `LEAST` or more."""
    estimate, nuisances = evaluation.estimate, evaluation.statistics.setup.nuisances
    known = np.flatnonzero(evaluation.determined)
    if estimate.crossed is None or estimate.nuisances.size != len(nuisances) or not known.size:
        return []
    out = []
    for k, nuisance in enumerate(nuisances):
        value, std = float(estimate.nuisances[k]), float(estimate.nuisances_std[k])
        if nuisance.name != "truncation" or not value > max(CONTINUOUS, CERTAIN * std):
            continue
        # The estimate with what rows say of the nuisance, less that with the nuisance held at zero.
        moved = estimate.crossed[k, known] * value / std**2
        deviations = np.abs(moved) / estimate.std[known]
        worst = int(np.argmax(deviations))
        if deviations[worst] > LEAST:
            link = evaluation.model.system.links[index_of(nuisance.where)]
            assert isinstance(link, FlexibleLink)
            share = float(moved[worst] / abs(estimate.pi[known[worst]]))
            name = evaluation.parameters[known[worst]].name
            out.append(Truncated(nuisance.where, link.elements, value, std, name, share, float(deviations[worst])))
    return out
