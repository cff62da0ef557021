"""The whole way from a session to a verdict: residual, effect, model with the effect, residual again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sms_online.calibration.found import Calibration
from sms_online.description.schema import System
from sms_online.diagnosis.attempt import FITTED_ONCE, SEARCHED, TRACED, Attempt, Case, Part, PriorOf, Progress
from sms_online.diagnosis.calibrated import covered
from sms_online.diagnosis.capture_changes import diagnosed_part, find_change
from sms_online.diagnosis.captures import begins, in_seconds, one_after_another, undone
from sms_online.diagnosis.drifts import explained_by_drifts, following, leaves_more, leaves_unexplained, may_explain
from sms_online.diagnosis.exact_links import with_exact_links
from sms_online.diagnosis.hypothesis import share_left, verdict
from sms_online.diagnosis.improvement import (
    explaining_alone,
    no_joint_worse,
    predicts_worse,
    supported,
    with_constants,
)
from sms_online.diagnosis.late_sensors import LateSensor, find_late
from sms_online.diagnosis.mistakes import MOST_WORSE, Mistake, find_mistakes, wrong_clock
from sms_online.diagnosis.record import SampleRecord, Segment
from sms_online.diagnosis.search import Search
from sms_online.diagnosis.torque_zeros import HELD_OUT, TorqueZero, torque_zeros, without_zeros
from sms_online.diagnosis.unexplained import describe_residual
from sms_online.effects.build import declaring
from sms_online.effects.catalogue import kinematic_candidates
from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.events import Event
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.row_types import LARGEST_RESIDUAL
from sms_online.stream import Block
from sms_online.threads import one_blas_thread
from sms_online.tracker_results import Drift
from sms_online.verdict.judge import at_noise
from sms_online.verdict.judged import JudgedEvaluation, evaluated


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
    reconstructed: tuple[str, ...] = (),
) -> Search:
    """Trace what a capture holds beyond its description, adopt it and fit again.

    blocks: samples of the capture; holdout: those of another one of the same rig, to check on. progress: see
    `Progress`. stop: whether to end with what has been found so far. learned: whether curves are tried where no law is
    selected. further: captures of the same rig that are searched with the first, each predicted from the others.
    reconstructed: channels that no sensor reads, see `smoother.reconstruction`.
    Raises InputError where a channel is missing or there is too little motion for any row.
    """
    runs = [blocks, *further]
    clock = wrong_clock(system, np.concatenate([block.t for block in blocks]))
    if clock is not None:
        runs, holdout = [in_seconds(run, clock.before) for run in runs], in_seconds(holdout, clock.before)
    runs = one_after_another(runs)
    before, record = _session(
        system, runs, source, prior, lambda share: progress("fitting the model as described", FITTED_ONCE * share)
    )
    _noise(before, source)
    progress("looking for mistakes of units, signs and wiring", FITTED_ONCE)
    corrected = find_mistakes(before, record.segments(), reconstructed)
    mistakes = () if clock is None else (clock,)
    if corrected.mistakes:
        progress("; ".join(mistake.sentence for mistake in corrected.mistakes), FITTED_ONCE)
        again: list[Sequence[Block]] = [undone(run, corrected) for run in runs]
        session, samples = _session(corrected.system, again, source, prior)
        # A rough fit allows for parameters that rows with weights do not.
        if not _fits_worse(session, before):
            mistakes = (*mistakes, *corrected.mistakes)
            system, runs, holdout = corrected.system, again, undone(holdout, corrected)
            before, record = session, samples
            _noise(before, source)
    held = _held(system, holdout, source, prior)
    case = Case(
        source, before, _noise(before, source), record.segments(), held, prior, progress, stop, learned,
        begins(runs), reconstructed=reconstructed,
    )  # fmt: skip
    progress("tracing what it leaves", FITTED_ONCE)
    case, attempt = _first(case, system)
    zeros = torque_zeros(attempt) if further or holdout else []
    if zeros:
        progress("; ".join(zero.sentence for zero in zeros), FITTED_ONCE)
        runs = [without_zeros(run, zeros, number) for number, run in enumerate(runs)]
        before, record = _session(system, runs, source, prior)
        held = _held(system, without_zeros(holdout, zeros, HELD_OUT), source, prior)
        noise = _noise(before, source)
        case = replace(case, session=before, noise=noise, segments=record.segments(), held=held)
        case, attempt = _first(case, system)
    rest = case, runs, holdout, mistakes, zeros
    jump = find_change(attempt, before.start_time) if len(runs) == 1 and attempt.tracing.exceeds else None
    if jump is not None:
        return _part_of(*rest, jump)
    followed = before
    described = attempt
    # From one capture to the next parameters may change at once.
    if len(runs) == 1 and not before.trackers[0].learns and leaves_more(before) and may_explain(attempt.rows):
        progress("looking for parameters that drift", FITTED_ONCE)
        followed, _ = _session(following(system), runs, source, prior)
    drifts = explained_by_drifts(followed)
    if drifts:
        return _drifting(case, followed, drifts, mistakes, zeros)
    late: list[LateSensor] = []
    little = _explains_little(before)
    while (sought := little or _may_be_late(attempt)) and (found := find_late(attempt.rows, reconstructed)):
        progress("taking off a sensor's lag", TRACED)
        late.append(found)
        attempt = Attempt(case, declaring(attempt.system, [found.effect]))
    progress("searching for effects", TRACED)
    chosen = attempt.search()
    if (
        not (sought or late or chosen or stop())
        and _beyond(attempt, chosen)
        and (found := find_late(attempt.rows, reconstructed))
    ):
        # All candidates together may explain what none of them does, by parameters that vanish.
        lagging = Attempt(case, declaring(system, [found.effect]))
        others = lagging.search()
        if not _beyond(lagging, others):
            late, attempt, chosen = [found], lagging, others
    if late and (forces := explaining_alone(case, system, attempt, chosen)):
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
    attempt, chosen, constants = with_constants(case, attempt, chosen, bare, progress)
    if not stop() and _beyond(attempt, chosen) and kinematic_candidates(attempt.system):
        progress("comparing exact links", SEARCHED)
        exact = with_exact_links(case, attempt, chosen)
        if exact is not None:
            beside = with_constants(case, exact, exact.search(), bare, progress)
            # Links that are exact because of what another effect did would keep that one from being found.
            if beside[0].excess(beside[1]) < attempt.excess(chosen):
                attempt, chosen, constants = beside
    chosen = no_joint_worse(attempt, chosen)
    after = attempt.state(chosen)
    while predicts_worse(bare.holdout.relative, after.holdout.relative) and earlier:
        attempt, chosen = earlier.pop()
        constants, after = [], attempt.state(chosen)
    late = late if attempt.system != system else []
    partial, estimator_after = stop(), before
    # Where parameters come from the rows of the diagnosis, no other session has any to give.
    what = "fitting the model with what was found"
    while after.system != system and not partial and not attempt.by_rows(chosen):
        estimator_after, _ = _session(
            after.system, runs, source, prior, lambda share: progress(what, SEARCHED + (1.0 - SEARCHED) * share)
        )
        kept = supported(attempt, chosen, estimator_after)
        if kept == chosen:
            break
        chosen, estimator_after = kept, before
        after = attempt.state(chosen)
    named = after.system != system
    attempt.tracing.weigh(chosen)
    findings = [*constants, *(attempt.tracing.finding(chosen, k) for k in chosen)]
    said = verdict(
        named, share_left(bare.excess, after.excess), after.test, bare.test, [each.candidate for each in findings]
    )
    now = evaluated(estimator_after)
    noisy = said == "unexplained" and at_noise(now.trust)
    if noisy and estimator_after is not before:
        # What is left beside the effects does not last.
        said = "named"
    # With what was found constant parameters explain the capture, though its session may take what a law is inexact by
    # for a change. What a change does not explain may only look like one.
    if not partial and said != "named" and len(runs) == 1:
        jump = _jump(before, attempt, chosen, said == "unexplained" and not noisy)
        if jump is not None:
            return _part_of(*rest, jump)
    grave = said == "clean" and now.trust.grave
    # What is left unexplained takes such numbers anywhere, and so do errors of reconstructed coordinates.
    anywhere = bool(reconstructed) or (said == "unexplained" and not noisy)
    calibration = () if anywhere else _miscalibrated(now, noisy and not named)
    if (said == "clean" and (mistakes or calibration)) or (noisy and calibration):
        said = "named"
    unexplained = None
    if grave:
        # Rows at noise and a model that cannot be: none of it is clean.
        said = "unexplained"
    elif said == "unexplained":
        unexplained = describe_residual(attempt.rows, attempt.tracing.columns(chosen), after.residual, bare.test)
    return Search(
        verdict=said,
        partial=partial,
        mistakes=mistakes,
        zeros=zeros,
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


def _fits_worse(session: Estimator, before: Estimator) -> bool:
    """Whether a session leaves clearly more of its noise than the one before."""
    now, then = (
        max((each.whitened or 0.0 for each in evaluated(one).residuals.values()), default=0.0)
        for one in (session, before)
    )
    return then > 0.0 and now > MOST_WORSE * max(then, 1.0)


def _jump(session: Estimator, attempt: Attempt, chosen: Sequence[int], unexplained: bool) -> Event | None:
    """A jump of parameters that a session has found, or that explains what is left beside the effects chosen."""
    jumps = [] if leaves_unexplained(session) else [event for event in session.events if event.parameters]
    if jumps or not unexplained:
        return jumps[0] if jumps else None
    return find_change(attempt, session.start_time, chosen)


def _part_of(
    case: Case,
    runs: Sequence[Sequence[Block]],
    holdout: Sequence[Block],
    mistakes: tuple[Mistake, ...],
    zeros: Sequence[TorqueZero],
    event: Event,
) -> Search:
    """What a capture holds before a jump of parameters, or behind it where that is far longer."""
    # No window of either part holds the jump.
    part, change = diagnosed_part(runs[0], event, case.session.system.windows.momentum)
    case.progress(change.sentence, FITTED_ONCE)
    found = diagnose(
        case.session.system, part, case.source, case.prior, holdout, case.progress, case.stop, case.learned,
        reconstructed=case.reconstructed,
    )  # fmt: skip
    return replace(
        found, mistakes=(*mistakes, *found.mistakes), zeros=[*zeros, *found.zeros], changes=(change, *found.changes)
    )


def _first(case: Case, system: System) -> tuple[Case, Attempt]:
    """The system against a case's samples, and the case, with the prior or without it.

    Rows that leave more than noise whatever is added contradict what is known beforehand, and effects that there are
    not would reconcile the two: what they lack is searched by what they say alone.
    InputError where readings are of shapes that links do not have.
    """
    alone = replace(case, use_prior=False)
    try:
        attempt = Attempt(alone, system)
    except np.linalg.LinAlgError as error:
        raise InputError(case.source, "", str(error), "the links' own markers, in their frames") from error
    if attempt.tracing.exceeds or case.prior(case.session) is None:
        return alone, attempt
    return case, Attempt(case, system)


def _drifting(
    case: Case,
    followed: Estimator,
    drifts: tuple[Drift, ...],
    mistakes: tuple[Mistake, ...],
    zeros: Sequence[TorqueZero],
) -> Search:
    """What a session that follows drifts has found; residuals after are of its rows, with the drift taken off."""
    before = case.session
    attempt = Attempt(case, before.system, candidates=())
    bare, now = attempt.state([]), evaluated(followed)
    left = {row: each for row, each in now.residuals.items() if row in bare.fit.whitened}
    part = Part(
        {row: each.whitened for row, each in left.items() if each.whitened is not None},
        {row: each.relative for row, each in left.items() if each.relative is not None},
    )
    return Search(
        verdict="named",
        partial=False,
        mistakes=mistakes,
        zeros=zeros,
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


def _miscalibrated(session: JudgedEvaluation, every: bool) -> tuple[Calibration, ...]:
    """Errors of a session's description beyond its tolerances that no effect of the catalogue covers, or every such."""
    known = () if every else covered(session.statistics.setup.system)
    return tuple(each for each in session.calibration if each.beyond and each.name not in known)


def _check_balanced(session: Estimator, source: str) -> None:
    if session.momentum is None:
        lacking = f"no {session.sensing.missing[0]}" if session.sensing.missing else 'balance = "energy"'
        raise InputError(
            source, "", f"{lacking}, so no momentum balance", "a system whose coordinates are all measured"
        )


def _held(system: System, holdout: Sequence[Block], source: str, prior: PriorOf) -> list[Segment]:
    """Samples of the capture that is held out, as a session of its own has them; none without one."""
    return _session(system, [holdout], source, prior)[1].segments() if holdout else []


def _noise(session: Estimator, source: str) -> SensorNoise:
    """The sensors' noise as a session found it; InputError where it had too few samples."""
    noise = None if session.momentum is None else session.momentum.sensor_noise
    if noise is None:
        raise InputError(source, "", "too few samples to estimate the sensors' noise", "a longer capture")
    return noise


def _beyond(attempt: Attempt, chosen: Sequence[int]) -> bool:
    """Whether rows leave more than noise with the effects chosen."""
    return any(row.beyond for row in attempt.test(chosen).values())


def _may_be_late(attempt: Attempt) -> bool:
    """Whether rows leave more than noise whatever is added; where all hold a torque, whether they leave more at all."""
    with_torque = np.any(attempt.rows.b, axis=0)
    return attempt.tracing.exceeds or (bool(with_torque.all()) and _beyond(attempt, ()))


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
    """A session of the blocks of some captures, one after the other, and their record; see `run_through`."""
    estimator = Estimator(system, runs[0][0].channels, source, whole=True)
    _check_balanced(estimator, source)
    record = SampleRecord(system.sample_rate)
    estimator.observers.append(record)
    run_through(estimator, runs, prior, progress)
    return estimator, record


def run_through(
    estimator: Estimator,
    runs: Sequence[Sequence[Block]],
    prior: PriorOf,
    progress: Callable[[float], None] = lambda share: None,
) -> None:
    """Give a session the blocks of some captures, one after the other, and end it.

    progress: is called with the share of the samples processed.
    """
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
