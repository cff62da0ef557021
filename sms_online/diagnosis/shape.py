"""Shape constants of an effect that was found (a Stribeck velocity, a gap), refined between the values that were tried."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize_scalar

from sms_online.diagnosis.candidates import CandidateColumns
from sms_online.diagnosis.trace import Candidate, Tracing
from sms_online.effects.catalogue import ENTRIES

# Relative accuracy of a shape constant, and evaluations at most.
TOLERANCE = 1e-3
EVALUATIONS = 25
# Constants that count something (of a cogging's period, say) are not refined.
COUNTED = ("order",)


def refine(tracing: Tracing, make: CandidateColumns, chosen: Sequence[int]) -> None:
    """Move the shape constants of the chosen candidates to where they take most, one after the other.

    Source of the search: Brent, Algorithms for Minimization without Derivatives, 1973, chapter 5.
    """
    for k in chosen:
        effect = tracing.candidates[k].effect
        shapes = [s for s in ENTRIES[effect.name].shapes if s in effect.coefficients and s not in COUNTED]
        others = [other for other in chosen if other != k]
        for shape in shapes:
            tried = sorted(
                c.effect.coefficients[shape] for c in tracing.candidates if c.key == tracing.candidates[k].key
            )
            here = tried.index(effect.coefficients[shape])
            if len(tried) < 2 or tried[0] <= 0.0:
                continue
            low, high = tried[max(0, here - 1)], tried[min(len(tried) - 1, here + 1)]
            # Beyond the ends of the grid by as much as to the next value inside.
            low = low if here > 0 else tried[0] ** 2 / tried[1]
            high = high if here < len(tried) - 1 else tried[-1] ** 2 / tried[-2]
            best: dict[float, Candidate] = {}

            def loss(log_value: float, shape: str = shape, k: int = k, best: dict[float, Candidate] = best) -> float:
                declared = tracing.candidates[k].effect
                moved = declared.coefficients | {shape: float(np.exp(log_value))}
                candidate = make.of(declared.model_copy(update={"coefficients": moved}))
                gain = tracing.gain_of(candidate, others).gain
                best[-gain] = candidate
                return -gain

            minimize_scalar(
                loss, bounds=(np.log(low), np.log(high)), method="bounded",
                options={"xatol": TOLERANCE, "maxiter": EVALUATIONS},
            )  # fmt: skip
            tracing.put(k, best[min(best)])
