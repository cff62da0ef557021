"""The whole way from a session to a verdict: residual, effect, model with the effect, residual again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from sms_online.calibration.found import Calibration
from sms_online.description.schema import Effect, System
from sms_online.diagnosis.attempt import (
    FITTED_ONCE,
    SEARCHED,
    TRACED,
    Attempt,
    Case,
    Part,
    PriorOf,
    Progress,
    State,
    Step,
)
from sms_online.diagnosis.calibrated import sayable
from sms_online.diagnosis.candidate import Finding, Ranked
from sms_online.diagnosis.captures import begins, in_seconds, one_after_another, undone
from sms_online.diagnosis.constants import possible
from sms_online.diagnosis.drifts import explained_by_drifts, following, leaves_more, may_explain
from sms_online.diagnosis.exact_links import with_exact_links
from sms_online.diagnosis.folds import LEAST_RISE
from sms_online.diagnosis.hypothesis import corrections, share_left, verdict
from sms_online.diagnosis.late_sensors import LateSensor, find_late
from sms_online.diagnosis.mistakes import Mistake, find_mistakes, wrong_clock
from sms_online.diagnosis.record import SampleRecord
from sms_online.diagnosis.unexplained import Unexplained, describe_residual
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import kinematic_candidates
from sms_online.errors import InputError
from sms_online.evaluation import Evaluation
from sms_online.model.model import Model
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.snapshot import statistics_of
from sms_online.stream import Array, Block
from sms_online.threads import one_blas_thread
from sms_online.tracker_results import Drift
from sms_online.verdict.judged import JudgedEvaluation
from sms_online.verdict.reasons import LARGEST_RESIDUAL

# What is found may leave so many times of the held-out torque that the description leaves: of rows without a torque it
# may explain all, and torques of noise differ by less.
WORSE = 1.1


@dataclass(frozen=True)
class Diagnosis:
    """What was found.

    verdict: "clean", "named" or "unexplained". partial: the search was ended before it was done, and parameters after
    are those of its rows. mistakes: of wiring, units and signs, undone in all that follows.
    calibration: what the description is off by, beyond its tolerances, that no effect of the catalogue says.
    findings: constants first, then the effects that are unknowns of π.
    late: sensors far behind the others, whose lag the description of the last attempt states. steps: of the last
    search, its effects one after the other.
    described, attempt: first and last description against the samples; chosen: of the last one's candidates.
    estimator_before, estimator_after: sessions of the two systems over the whole capture; the first one again where the
    search is partial or parameters come from its own rows. drifts: parameters that drift, which the second follows;
    nothing else is searched then.
    """

    verdict: str
    partial: bool
    mistakes: tuple[Mistake, ...]
    calibration: tuple[Calibration, ...]
    findings: list[Finding]
    late: list[LateSensor]
    ranking: list[Ranked]
    described: Attempt
    attempt: Attempt
    steps: list[Step]
    chosen: list[int]
    before: State
    after: State
    estimator_before: Estimator
    estimator_after: Estimator
    unexplained: Unexplained | None
    drifts: tuple[Drift, ...] = ()

    @property
    def left(self) -> float:
        """Share of what was beyond noise that is left with what was found."""
        return share_left(self.before.excess, self.after.excess)

    @cached_property
    def model(self) -> Model:
        """Of the system with what was found, whether or not there was a session of it."""
        same = self.estimator_after.system == self.after.system
        return self.estimator_after.model if same else build_model(self.after.system)


def _trial(attempt: Attempt, forces: Sequence[Effect], constants: Sequence[Effect], beta: Array) -> Attempt:
    return attempt.trial(attempt.system, constants, beta, forces)


def _with_constants(
    case: Case, attempt: Attempt, chosen: list[int], bare: State, progress: Progress
) -> tuple[Attempt, list[int], list[Finding]]:
    """The attempt with constants in place of the effects found that become such, what is found beside them, and these.

    Samples are corrected by the constants, and what these leave, or have hidden, is searched again; not by those with
    which held-out torques are predicted worse than by the description alone, whose state is `bare`.
    """
    n = attempt.rows.base.n
    findings: list[Finding] = []
    while any(attempt.tracing.candidates[k].constant for k in chosen):
        progress("improving constants", SEARCHED)
        before = attempt, [k for k in chosen if not attempt.tracing.candidates[k].constant]
        findings += [attempt.tracing.finding(chosen, k) for k in chosen if attempt.tracing.candidates[k].constant]
        solution = attempt.solution(chosen)
        fresh, forces = attempt.found(chosen, solution)
        constants, beta = [*attempt.constants, *fresh], solution[:n]
        trial = partial(_trial, attempt, forces)
        for correction in corrections(trial, constants, beta):
            constants, beta = correction.constants, correction.solution[:n]
            if correction.converged or case.stop():
                break
        keys = {(effect.name, effect.where) for effect in constants}
        constants = [effect for effect in constants if possible(effect, case.session.system.sample_rate)]
        tried = [candidate.effect for candidate in attempt.tracing.candidates]
        others = [effect for effect in tried if (effect.name, effect.where) not in keys]
        attempt = Attempt(case, attempt.system, constants, beta, others)
        # Forces that only stood for a constant have nothing left to explain.
        chosen = attempt.search(forces)
        attempt.conclude(chosen)
        if predicts_worse(bare.holdout.relative, attempt.state(chosen).holdout.relative):
            attempt, chosen = before
            break
    standing = {(effect.name, effect.where) for effect in attempt.constants}
    findings = [f for f in findings if (f.candidate.effect.name, f.candidate.effect.where) in standing]
    return attempt, chosen, findings


@one_blas_thread()
def diagnose(
    system: System,
    blocks: Sequence[Block],
    source: str,
    prior: PriorOf,
    holdout: Sequence[Block] = (),
    progress: Progress = lambda what, share: None,
    stop: Callable[[], bool] = lambda: False,
    learned: bool = False,
    further: Sequence[Sequence[Block]] = (),
) -> Diagnosis:
    """Trace what a capture holds beyond its description, adopt it and fit again.

    blocks: samples of the capture; holdout: those of another one of the same rig, to check on. progress: see
    `Progress`. stop: whether to end with what has been found so far. learned: whether curves are tried where no law is
    selected. further: captures of the same rig that are searched with the first, each predicted from the others.
    Raises InputError where a channel is missing or there is too little motion for any row.
    """
    what = "fitting the model as described"
    runs = [blocks, *further]
    clock = wrong_clock(system, np.concatenate([block.t for block in blocks]))
    if clock is not None:
        runs, holdout = [in_seconds(run, clock.before) for run in runs], in_seconds(holdout, clock.before)
    runs = one_after_another(runs)
    before, record = _session(system, runs, source, prior, lambda share: progress(what, FITTED_ONCE * share))
    _check_measured(before, source)
    progress("looking for mistakes of units, signs and wiring", FITTED_ONCE)
    corrected = find_mistakes(before, record.segments())
    mistakes = (*([] if clock is None else [clock]), *corrected.mistakes)
    if corrected.mistakes:
        progress("; ".join(mistake.sentence for mistake in corrected.mistakes), FITTED_ONCE)
        system = corrected.system
        runs, holdout = [undone(run, corrected) for run in runs], undone(holdout, corrected)
        before, record = _session(system, runs, source, prior)
        _check_measured(before, source)
    assert before.momentum is not None
    assert before.momentum.sensor_noise is not None
    held = _session(system, [holdout], source, prior)[1].segments() if holdout else []
    case = Case(
        source, before, before.momentum.sensor_noise, record.segments(), held, prior, progress, stop, learned,
        begins(runs),
    )  # fmt: skip
    progress("tracing what it leaves", FITTED_ONCE)
    try:
        attempt = described = Attempt(case, system)
    except np.linalg.LinAlgError as error:
        raise InputError(source, "", str(error), "the links' own markers, in their frames") from error
    followed = before
    # From one capture to the next parameters may change at once.
    if len(runs) == 1 and not before.trackers[0].learns and leaves_more(before) and may_explain(attempt.rows):
        progress("looking for parameters that drift", FITTED_ONCE)
        followed, _ = _session(following(system), runs, source, prior)
    drifts = explained_by_drifts(followed)
    if drifts:
        return _drifting(case, followed, drifts, mistakes)
    # Windows that nothing explained are a diagnosis's own affair; a change of parameters is not.
    changes = [event for event in before.events if event.parameters]
    if changes:
        event = changes[0]
        expected = "a part without it: -ss or -to"
        raise InputError(source, f"{event.time:.2f} s", f"an event ({event.kind}) within the capture", expected)
    late: list[LateSensor] = []
    while (_explains_little(before) or attempt.tracing.freed) and (found := find_late(attempt.rows)):
        progress("taking off a sensor's lag", TRACED)
        late.append(found)
        lagging = attempt.system.model_copy(update={"effects": (*attempt.system.effects, found.effect)})
        attempt = Attempt(case, lagging)
    progress("searching for effects", TRACED)
    chosen = attempt.search()
    if late and (forces := _explaining_alone(case, system, attempt, chosen)):
        late, attempt = [], Attempt(case, system)
        chosen = attempt.search(forces)
    if late:
        # With the same weights, so that before and after are in the same measure.
        described = Attempt(case, system, (), attempt.rows.beta, ())
    earlier: list[tuple[Attempt, list[int]]] = [(described, []), (attempt, [])]
    bare = described.state([])
    attempt.tracing.weigh([])
    ranking = attempt.tracing.ranking()
    attempt.tracing.weigh(chosen)
    attempt, chosen, constants = _with_constants(case, attempt, chosen, bare, progress)
    beyond = not stop() and any(row.beyond for row in attempt.test(chosen).values())
    if beyond and kinematic_candidates(attempt.system):
        progress("comparing exact links", SEARCHED)
        exact = with_exact_links(case, attempt, chosen)
        if exact is not None:
            beside = _with_constants(case, exact, exact.search(), bare, progress)
            # Links that are exact because of what another effect did would keep that one from being found.
            if beside[0].excess(beside[1]) < attempt.excess(chosen):
                attempt, chosen, constants = beside
    chosen = _no_joint_worse(attempt, chosen)
    after = attempt.state(chosen)
    while predicts_worse(bare.holdout.relative, after.holdout.relative) and earlier:
        attempt, chosen = earlier.pop()
        constants, after = [], attempt.state(chosen)
    late = late if attempt.system != system else []
    attempt.tracing.weigh(chosen)
    findings = [*constants, *(attempt.tracing.finding(chosen, k) for k in chosen)]
    named, partial = after.system != system, stop()
    estimator_after = before
    # Where parameters come from the rows of the diagnosis, no other session has any to give.
    if named and not partial and not attempt.by_rows:
        what, rest = "fitting the model with what was found", 1.0 - SEARCHED
        estimator_after, _ = _session(
            after.system, runs, source, prior, lambda share: progress(what, SEARCHED + rest * share)
        )
    said = verdict(
        named, share_left(bare.excess, after.excess), after.test, bare.test, [each.candidate for each in findings]
    )
    grave = said == "clean" and JudgedEvaluation(statistics_of(before), before.estimate()).trust.grave
    # What is left unexplained takes such numbers anywhere.
    calibration = () if said == "unexplained" else _miscalibrated(estimator_after)
    if said == "clean" and (mistakes or calibration):
        said = "named"
    unexplained = None
    if grave:
        # Rows at noise and a model that cannot be: none of it is clean.
        said = "unexplained"
    elif said == "unexplained":
        unexplained = describe_residual(attempt.rows, attempt.tracing.columns(chosen), after.residual, bare.test)
    return Diagnosis(
        verdict=said,
        partial=partial,
        mistakes=mistakes,
        calibration=calibration,
        findings=findings,
        late=late,
        ranking=ranking,
        described=described,
        attempt=attempt,
        steps=attempt.steps(chosen),
        chosen=chosen,
        before=bare,
        after=after,
        estimator_before=before,
        estimator_after=estimator_after,
        unexplained=unexplained,
    )


def _explaining_alone(case: Case, system: System, attempt: Attempt, chosen: Sequence[int]) -> list[Effect]:
    """Effects found beside a sensor's lag that leave no more than noise without it; none where they leave more.

    Few windows do not distinguish a lag from what was not yet in the model when it was looked for.
    """
    forces = [attempt.tracing.candidates[k].effect for k in chosen]
    if not forces or attempt.tracing.freed:
        return []
    alone = Attempt(case, system, candidates=forces)
    beyond = any(row.beyond for row in alone.test(range(len(alone.tracing.candidates))).values())
    return [] if beyond else forces


def _no_joint_worse(attempt: Attempt, chosen: list[int]) -> list[int]:
    """Those chosen, or the last of the search's steps to them after which no joint's held-out torque is predicted worse
    than without any: what serves one axis by way of the masses may harm another.

    All of those chosen where rows leave no more than noise: by that torques differ.
    """
    if not attempt.tracing.freed:
        return chosen
    before = attempt.state([]).holdout.relative
    for step in (chosen, *(step for _, step in reversed(attempt.tracing.path) if step != chosen)):
        after = attempt.state(step).holdout.relative
        if all(after[row] <= (1.0 + LEAST_RISE) * before[row] for row in before.keys() & after.keys()):
            return step
    return []


def predicts_worse(before: Mapping[str, float], after: Mapping[str, float]) -> bool:
    """Whether shares of the torque left of blocks that were not fitted, by joint, are larger after than before.

    Corrections are found to first order; taken whole, they may leave more than they explained.
    """
    both = [(before[row], after[row]) for row in before.keys() & after.keys()]
    squares = np.sum(np.square(both), axis=0) if both else np.zeros(2)
    return bool(squares[1] > WORSE**2 * squares[0])


def _drifting(case: Case, followed: Estimator, drifts: tuple[Drift, ...], mistakes: tuple[Mistake, ...]) -> Diagnosis:
    """What a session that follows drifts has found; residuals after are of its rows, with the drift taken off."""
    before = case.session
    attempt = Attempt(case, before.system, candidates=())
    bare, now = attempt.state([]), Evaluation(statistics_of(followed), followed.estimate())
    left = {row: each for row, each in now.residuals.items() if row in bare.fit.whitened}
    part = Part(
        {row: each.whitened for row, each in left.items() if each.whitened is not None},
        {row: each.relative for row, each in left.items() if each.relative is not None},
    )
    return Diagnosis(
        verdict="named",
        partial=False,
        mistakes=mistakes,
        calibration=(),
        findings=[],
        late=[],
        ranking=[],
        described=attempt,
        attempt=attempt,
        steps=[],
        chosen=[],
        before=bare,
        after=replace(bare, system=followed.system, fit=part, holdout=part),
        estimator_before=before,
        estimator_after=followed,
        unexplained=None,
        drifts=drifts,
    )


def _miscalibrated(session: Estimator) -> tuple[Calibration, ...]:
    """Errors of a session's description beyond its tolerances that no effect of the catalogue covers."""
    every = Evaluation(statistics_of(session), session.estimate()).calibration
    return tuple(each for each in every if each.beyond and each.name not in sayable(session.system))


def _check_measured(session: Estimator, source: str) -> None:
    if session.momentum is None:
        lacking = f"no {session.sensing.missing[0]}" if session.sensing.missing else 'balance = "energy"'
        raise InputError(
            source, "", f"{lacking}, so no momentum balance", "a system whose coordinates are all measured"
        )
    if session.momentum.sensor_noise is None:
        raise InputError(source, "", "too few samples to estimate the sensors' noise", "a longer capture")


def _explains_little(estimator: Estimator) -> bool:
    """Whether a session's own fit leaves more than half of a joint's torque."""
    beta = estimator.estimate().pi
    shares = [joint.relative(beta) for joint in estimator.energy.joint_residuals]
    return not estimator.by_smoother and any(share is not None and share > LARGEST_RESIDUAL for share in shares)


def _session(
    system: System,
    runs: Sequence[Sequence[Block]],
    source: str,
    prior: PriorOf,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[Estimator, SampleRecord]:
    """A session of the blocks of some captures, one after the other, and their record.

    progress: is called with the share of the samples processed.
    """
    estimator = Estimator(system, runs[0][0].channels, source)
    record = SampleRecord(system.sample_rate)
    estimator.observers.append(record)
    known = prior(estimator)
    if known is not None:
        estimator.set_prior(known)
    samples = sum(block.t.size for run in runs for block in run)
    for number, run in enumerate(runs):
        if number:
            estimator.renew()  # what lies between two captures is not lost
        for block in run:
            estimator.push(block)
            progress(estimator.samples / samples)
    estimator.finish()
    return estimator, record
