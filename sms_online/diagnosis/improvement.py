"""What a search has found, improved: constants in place of effects, and nothing that predicts torques worse."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sms_online.description.schema import Effect, System
from sms_online.diagnosis.attempt import SEARCHED, Attempt, Case, ModelFit, Progress
from sms_online.diagnosis.candidate import Finding
from sms_online.diagnosis.constants import possible
from sms_online.diagnosis.folds import LEAST_RISE
from sms_online.diagnosis.hypothesis import ConstantsStep, corrections
from sms_online.diagnosis.trace import DECISIVE
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array
from sms_online.verdict.judged import evaluated

# What is found may leave so many times of the held-out torque that the description leaves: of rows without a torque it
# may explain all, and torques of noise differ by less.
WORSE = 1.1


def with_constants(
    case: Case, attempt: Attempt, chosen: list[int], bare: ModelFit, progress: Progress
) -> tuple[Attempt, list[int], list[Finding]]:
    """The attempt with constants in place of the effects found that become such, what is found beside them, and these.

    Samples are corrected by the constants, and what these leave, or have hidden, is searched again; not by those with
    which held-out torques are predicted worse than by the description alone, whose state is `bare`.
    """
    findings: list[Finding] = []
    while any(attempt.tracing.candidates[k].constant for k in chosen):
        progress("improving constants", SEARCHED)
        before = attempt, [k for k in chosen if not attempt.tracing.candidates[k].constant]
        chosen, correction, refuted = _distinguished(case, attempt, chosen)
        found = [attempt.tracing.finding(chosen, k) for k in chosen if attempt.tracing.candidates[k].constant]
        findings += [
            replace(each, ambiguous=tuple(key for key in each.ambiguous if key not in refuted)) for each in found
        ]
        constants, beta = correction.constants, correction.solution[: attempt.rows.base.n]
        forces = attempt.found(chosen, attempt.solution(chosen))[1]
        keys = {effect.key for effect in constants}
        # What explained a part of another constant may have next to nothing left beside it.
        rate, tolerated = case.session.system.sample_rate, attempt.rows.calibrated.tolerates
        constants = [effect for effect in constants if possible(effect, rate) and not tolerated(effect)]
        tried = [candidate.effect for candidate in attempt.tracing.candidates]
        others = [effect for effect in tried if effect.key not in keys]
        attempt = Attempt(case, attempt.system, constants, beta, others)
        # Forces that only mimicked a constant have nothing left to explain.
        chosen = attempt.search(forces)
        attempt.conclude(chosen)
        if predicts_worse(bare.holdout.relative, attempt.state(chosen).holdout.relative):
            attempt, chosen = before
            break
    kept = {effect.key for effect in attempt.constants}
    findings = [f for f in findings if f.candidate.key in kept]
    return attempt, chosen, findings


def _improved(case: Case, attempt: Attempt, chosen: Sequence[int]) -> ConstantsStep:
    """The constants among those chosen, beside those that samples are corrected by already, improved together."""
    solution = attempt.solution(chosen)
    fresh, forces = attempt.found(chosen, solution)
    beta = solution[: attempt.rows.base.n]

    def trial(constants: Sequence[Effect], beta: Array) -> Attempt:
        return attempt.trial(attempt.system, constants, beta, forces)

    for correction in corrections(trial, [*attempt.constants, *fresh], beta):
        if correction.converged or case.stop():
            break
    return correction


def _distinguished(case: Case, attempt: Attempt, chosen: list[int]) -> tuple[list[int], ConstantsStep, set[str]]:
    """Those chosen, with a rival in the place of a constant where samples that it corrects leave clearly less; the
    improved constants; and keys of those that leave clearly more than the ones in their place.

    To first order the zero of an encoder may be that of the other one of its joint. Corrected samples show which it is.
    """
    candidates, refuted = attempt.tracing.candidates, set[str]()
    best = _improved(case, attempt, chosen)
    for place in [n for n, k in enumerate(chosen) if candidates[k].constant]:
        keys = attempt.tracing.finding(chosen, chosen[place]).ambiguous
        for rival in [j for j, each in enumerate(candidates) if each.constant and each.key in keys]:
            if case.stop():
                break
            instead = [*chosen[:place], rival, *chosen[place + 1 :]]
            other = _improved(case, attempt, instead)
            gained = best.misfit - other.misfit
            if abs(gained) > DECISIVE:
                refuted.add(candidates[chosen[place] if gained > 0.0 else rival].key)
            if gained > DECISIVE:
                best, chosen = other, instead
    return chosen, best, refuted


def explaining_alone(case: Case, system: System, attempt: Attempt, chosen: Sequence[int]) -> list[Effect]:
    """Effects found beside a sensor's lag that leave no more than noise without it; none where they leave more.

    Few windows do not distinguish a lag from what was not yet in the model when it was looked for.
    """
    forces = [attempt.tracing.candidates[k].effect for k in chosen]
    if not forces or attempt.tracing.exceeds:
        return []
    alone = Attempt(case, system, candidates=forces)
    beyond = any(row.beyond for row in alone.test(range(len(alone.tracing.candidates))).values())
    return [] if beyond else forces


def no_joint_worse(attempt: Attempt, chosen: list[int]) -> list[int]:
    """Those chosen, or the last of the search's steps to them after which no joint's held-out torque is predicted worse
    than without any: what serves one axis by way of the masses may harm another.

    All of those chosen where rows leave no more than noise: by that torques differ.
    """
    if not attempt.tracing.exceeds:
        return chosen
    before = attempt.state([]).holdout.relative
    for step in (chosen, *(step for _, step in reversed(attempt.tracing.path) if step != chosen)):
        after = attempt.state(step).holdout.relative
        if all(after[row] <= (1.0 + LEAST_RISE) * before[row] for row in before.keys() & after.keys()):
            return step
    return []


def supported(attempt: Attempt, chosen: list[int], session: Estimator) -> list[int]:
    """Those chosen, but for those that neither a session of the whole capture nor its held-out torques support.

    The session determines none of their coefficients: it allows for more than the search does, for changes and for
    noise in columns. And without them no joint's torque is predicted clearly worse.
    """
    parameters, determined = session.base.parameters, evaluated(session).determined
    known = {p.name for p, is_known in zip(parameters, determined, strict=True) if is_known}
    weak = {p.name for p in parameters} - known
    kept, tracing = list(chosen), attempt.tracing
    own = {k: {p.name for p in tracing.candidates[k].parameters} for k in chosen}
    doubtful = [k for k in chosen if own[k] and own[k] <= weak]
    # Of effects that explain the same the weaker one goes.
    for k in sorted(doubtful, key=lambda k: tracing.improvement([other for other in chosen if other != k], k).share):
        without = [other for other in kept if other != k]
        with_it, less = (attempt.state(each).holdout.relative for each in (kept, without))
        least = tracing.least_improvement(k)
        if with_it and all(with_it[row] > (1.0 - least) * less[row] for row in with_it):
            kept = without
    return kept


def predicts_worse(before: Mapping[str, float], after: Mapping[str, float]) -> bool:
    """Whether shares of the torque left of blocks that were not fitted, by joint, are larger after than before.

    Corrections are found to first order; taken whole, they may leave more than they explained.
    """
    both = [(before[row], after[row]) for row in before.keys() & after.keys()]
    squares = np.sum(np.square(both), axis=0) if both else np.zeros(2)
    return bool(squares[1] > WORSE**2 * squares[0])
