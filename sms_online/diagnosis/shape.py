"""Shape constants of an effect that was found (a Stribeck velocity, a gap), refined between the values tried before."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize_scalar

from sms_online.description.schema import Effect
from sms_online.diagnosis.candidate import Candidate
from sms_online.diagnosis.candidates import CandidateColumns
from sms_online.diagnosis.trace import Tracing
from sms_online.effects.catalogue import ENTRIES
from sms_online.stream import Array

# Relative accuracy of a shape constant: twenty seconds give the frequency of a mass that rings with 100 N to 1e-7, and
# a phase that is off moves the parameters. And evaluations at most.
TOLERANCE = 1e-7
EVALUATIONS = 40
# Relative step of slopes by a shape constant: twenty seconds of a slow ringing turn on by a milliradian.
STEP = 1e-5
# Times that a shape constant follows from coefficients, which follow from it: the second is off by the first's square.
ITERATIONS = 2


def refine(tracing: Tracing, make: CandidateColumns, chosen: Sequence[int], k: int) -> None:
    """Move the shape constants of candidate k, one of those chosen, to where it takes most, one after the other.

    Source of the search: Brent, Algorithms for Minimization without Derivatives, 1973, chapter 5.
    """
    for shape, constant in ENTRIES[tracing.candidates[k].effect.name].shapes.items():
        if shape in tracing.candidates[k].effect.coefficients and not constant.counted:
            _refine_one(tracing, make, chosen, k, shape)
    _follow_coefficients(tracing, make, chosen, k)


def slopes(tracing: Tracing, make: CandidateColumns, chosen: Sequence[int]) -> tuple[list[tuple[str, str]], Array]:
    """Shape constants of those chosen that the rows determine, key of effect and name, and slopes of the rows by them.

    (W, n_v, shapes). What follows from coefficients is none of them.
    """
    names, found = [], [np.empty((*tracing.rows.b.shape, 0))]
    solution = tracing.solution(chosen)
    at = tracing.n_model
    for candidate in (tracing.candidates[k] for k in chosen):
        effect, own = candidate.effect, solution[at : at + len(candidate.parameters)]
        at += own.size
        for shape in _refined_by_rows(effect):
            value = effect.coefficients[shape]
            there, back = (
                make.of(effect.model_copy(update={"coefficients": effect.coefficients | {shape: moved}})).columns @ own
                for moved in (value * (1.0 + STEP), value * (1.0 - STEP))
            )
            names.append((candidate.key, shape))
            found.append(((there - back) / (2.0 * STEP * value))[..., None])
    return names, np.concatenate(found, axis=2)


def _refined_by_rows(effect: Effect) -> list[str]:
    """Shape constants of an effect that are refined for themselves."""
    shapes = ENTRIES[effect.name].shapes
    refined = [s for s, constant in shapes.items() if effect.coefficients.get(s, 0.0) > 0.0 and not constant.counted]
    # A gap is reported for itself, where others have a coefficient too.
    return refined if set(ENTRIES[effect.name].coefficients) - set(shapes) else []


def _follow_coefficients(tracing: Tracing, make: CandidateColumns, chosen: Sequence[int], k: int) -> None:
    """Give shape constants the values that a person reads, where these follow from coefficients beside them.

    A gap where the spring is soft is as much as it takes off beyond, over the joint's stiffness: rows beyond give that
    to 1e-4, and the gap itself, with a stiffness of its own inside, to percents where the spring is seldom in it.
    """
    entry = ENTRIES[tracing.candidates[k].effect.name]
    if entry.kind != "force" or all(constant.counted for constant in entry.shapes.values()):
        return
    for _ in range(ITERATIONS):
        effect = tracing.candidates[k].effect
        solution = tracing.solution(chosen)
        sizes = [len(tracing.candidates[other].parameters) for other in chosen]
        first = tracing.n_model + sum(sizes[: chosen.index(k)])
        own = solution[first : first + sizes[chosen.index(k)]]
        reported = make.reported(effect, solution[: tracing.rows.Y.shape[2]], own)
        moved = effect.coefficients | {name: reported[name] for name in effect.coefficients.keys() & reported.keys()}
        if moved == effect.coefficients or min(moved.values()) <= 0.0:
            return
        tracing.put(k, make.of(effect.model_copy(update={"coefficients": moved})))


def _refine_one(tracing: Tracing, make: CandidateColumns, chosen: Sequence[int], k: int, shape: str) -> None:
    effect, key = tracing.candidates[k].effect, tracing.candidates[k].key
    others = [other for other in chosen if other != k]
    tried = sorted({c.effect.coefficients[shape] for c in tracing.candidates if c.key == key})
    if len(tried) < 2 or tried[0] <= 0.0:
        return
    here = tried.index(effect.coefficients[shape])
    # Beyond the ends of the grid by as much as to the next value inside: further off it is another effect.
    grid = ENTRIES[effect.name].shapes[shape].grid(make.ranges(effect.where))
    low = tried[here - 1] if here > 0 else grid[0] ** 2 / grid[1]
    high = tried[here + 1] if here < len(tried) - 1 else grid[-1] ** 2 / grid[-2]
    best: dict[float, Candidate] = {}

    def loss(log_value: float) -> float:
        moved = effect.coefficients | {shape: float(np.exp(log_value))}
        candidate = make.of(effect.model_copy(update={"coefficients": moved}))
        gain = tracing.gain_of(candidate, others).gain
        best[-gain] = candidate
        return -gain

    bounds = (float(np.log(low)), float(np.log(high)))
    minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": TOLERANCE, "maxiter": EVALUATIONS})
    tracing.put(k, best[min(best)])
