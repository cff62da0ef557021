"""The whole way from a session to a verdict: residual, effect, model with the effect, residual again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sms_online.description.schema import Effect, System
from sms_online.diagnosis.candidates import CandidateColumns, corrected, with_coefficients
from sms_online.diagnosis.record import LONGEST, SampleRecord, Segment, excerpts
from sms_online.diagnosis.relative import RelativeResiduals
from sms_online.diagnosis.residuals import ResidualTest, RowResidual, whitened
from sms_online.diagnosis.rows import SessionRows
from sms_online.diagnosis.shape import refine
from sms_online.diagnosis.trace import Candidate, Finding, Ranked, Tracing
from sms_online.diagnosis.unexplained import Unexplained, describe_residual
from sms_online.effects.catalogue import ENTRIES, places
from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array, Block
from sms_online.trackers.interface import Prior

# Share of a session that coefficients are fitted to where no other capture is held out; the rest checks them.
FITTED = 2.0 / 3.0
# A verdict names effects that take away all but this share of what is beyond noise.
LARGEST_SHARE_LEFT = 0.1
# Times that the constants of channels' effects are improved, each with samples corrected by those found before.
CORRECTIONS = 3
# Stretches of a session that is used in part, in window lengths.
STRETCH = 5.0
# Part of a session that tells which kinematics of links are nearer, and improves channels' constants, s.
SOME = 8.0


@dataclass(frozen=True)
class Part:
    """Residuals of a model with what was fitted, by row type; whitened over the predicted deviation, relative to the
    measured torque or force."""

    whitened: dict[str, float]
    relative: dict[str, float]


@dataclass(frozen=True)
class State:
    """What a model, with or without the effects found, makes of the session.

    system: with the effects. solution (n + c,): parameters and coefficients fitted to the fitted windows. residual (W,
    n_v): of all windows, over each row's own predicted deviation; time (W,): their middles, s since grid index 0.
    """

    system: System
    solution: Array
    residual: Array
    time: Array
    fitted: NDArray[np.bool_]
    fit: Part
    holdout: Part
    test: dict[str, RowResidual]

    @property
    def excess(self) -> float:
        """Sum of squares beyond noise."""
        return float(np.sum(self.residual**2) - self.residual.size)


@dataclass(frozen=True)
class Diagnosis:
    """What was found.

    verdict: "clean", "named" or "unexplained". findings: with their candidates' columns in the rows of `after`.
    estimator_before, estimator_after: sessions of the two systems over the whole capture.
    """

    verdict: str
    findings: list[Finding]
    ranking: list[Ranked]
    before: State
    after: State
    estimator_before: Estimator
    estimator_after: Estimator
    unexplained: Unexplained | None


# Gives what is known beforehand of the parameters of an estimator's model.
PriorOf = Callable[[Estimator], Prior | None]


class Attempt:
    """One description of the system against the samples of the session."""

    def __init__(
        self,
        system: System,
        session: Estimator,
        segments: Sequence[Segment],
        held: Sequence[Segment],
        prior: PriorOf,
        beta: Array | None = None,
        candidates: Sequence[Candidate] | Sequence[Effect] | None = None,
        most: float = LONGEST,
    ) -> None:
        """beta (n,): behind the noise of rows, the session's unless given. candidates: all by default; columns made for
        the same windows before serve to search. most: s of the session that are used."""
        self.system, self._session = system, session
        momentum = session.momentum
        assert momentum is not None
        noise = momentum.sensor_noise
        assert noise is not None
        estimator = Estimator(system, session.sensing.channels, "") if system is not session.system else session
        known = prior(estimator)
        if beta is None:
            beta = session.estimate().pi
            if known is not None and not session.by_momentum:
                # A fit that leaves half of the torques bends everything; what was known before is nearer.
                beta = np.where(known.known, known.value, beta)
        noise = replace(noise, coordinates=estimator.sensing.coordinate_noise(noise.grid))
        channels = session.sensing.channels
        length, most_samples = (
            round(seconds * system.sample_rate) for seconds in (STRETCH * system.windows.momentum, most)
        )
        parts = [excerpts(each, length, most_samples) for each in (segments, held)]
        values = [_without_channel_effects(system, channels, segment) for part in parts for segment in part]
        self.rows = SessionRows(estimator.model, estimator.base, estimator.sensing, noise, values, beta)
        if self.rows.count == 0:
            raise InputError(system.name, "", "no gapless stretch of a window's length", "more samples")
        self.make = CandidateColumns(self.rows, system)
        self.fixed = [effect for effect in system.effects if ENTRIES[effect.name].kind == "channel"]
        self._fitting = len(parts[0])
        first, last = self.rows.time[0], self.rows.time[-1]
        self._split = np.inf if held else first + FITTED * (last - first)
        fitted = self._fitted(self.rows.time, self.rows.weak.windows.segment)
        made = self.make.all() if candidates is None else [self._made(candidate) for candidate in candidates]
        fixed = [self.make.of(effect) for effect in self.fixed]
        self.tracing = Tracing(self.rows, made, fitted, known, fixed)

    def _made(self, candidate: Candidate | Effect) -> Candidate:
        return candidate if isinstance(candidate, Candidate) else self.make.of(candidate)

    def _fitted(self, time: Array, segment: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.asarray((segment < self._fitting) & (time < self._split))

    def solution(self, chosen: Sequence[int]) -> Array:
        """Parameters and coefficients from all windows."""
        return self.tracing.solution(chosen, np.ones(self.rows.count, dtype=bool))

    def excess(self, chosen: Sequence[int]) -> float:
        """Sum of squares that is left beyond noise."""
        residual = self.tracing.residual(chosen, self.solution(chosen))
        return float(np.sum(residual**2) - residual.size)

    def increments(self, solution: Array) -> System:
        """The system with the constants of its channels' effects improved by a solution's coefficients."""
        return self._with_constants(self.fixed, solution[self.rows.base.n :])

    def adopted(self, chosen: Sequence[int], solution: Array) -> System:
        """The system with the effects chosen; those of channels with their constants."""
        effects = [self.tracing.candidates[k].effect for k in chosen]
        fixed = sum(len(self.make.of(effect).parameters) for effect in self.fixed)
        system = self.system.model_copy(update={"effects": (*self.system.effects, *effects)})
        at, out = self.rows.base.n + fixed, list(system.effects)
        for k in chosen:
            candidate = self.tracing.candidates[k]
            values = solution[at : at + len(candidate.parameters)]
            at += len(candidate.parameters)
            if ENTRIES[candidate.effect.name].kind == "channel":
                out[out.index(candidate.effect)] = with_coefficients(candidate.effect, values)
        return system.model_copy(update={"effects": tuple(out)})

    def _with_constants(self, effects: Sequence[Effect], values: Array) -> System:
        out, at = list(self.system.effects), 0
        for effect in effects:
            size = len(self.make.of(effect).parameters)
            out[out.index(effect)] = with_coefficients(effect, values[at : at + size])
            at += size
        return self.system.model_copy(update={"effects": tuple(out)})

    def state(self, chosen: Sequence[int]) -> State:
        """Residuals of the model with the effects chosen."""
        rows, tracing = self.rows, self.tracing
        fitted = tracing.fitted
        solution = tracing.solution(chosen, fitted)
        residual = tracing.residual(chosen, solution)
        joints = RelativeResiduals(rows, self.make)
        joints.declare([*self.fixed, *(tracing.candidates[k].effect for k in chosen)])
        early = self._fitted(joints.times, joints.segment)
        return State(
            system=self.adopted(chosen, solution),
            solution=solution,
            residual=residual,
            time=rows.time,
            fitted=fitted,
            fit=Part(whitened(rows, residual, fitted), joints.of(solution, early)),
            holdout=Part(whitened(rows, residual, ~fitted), joints.of(solution, ~early)),
            test=ResidualTest(rows).of(residual),
        )


def _without_channel_effects(system: System, channels: tuple[str, ...], segment: Segment) -> Segment:
    values = segment.values
    for effect in system.effects:
        if ENTRIES[effect.name].kind == "channel":
            values = corrected(channels, values, effect, system)
    return Segment(segment.index, values)


def _without(system: System, effects: Sequence[Effect]) -> System:
    """The system without some of its effects."""
    return system.model_copy(update={"effects": tuple(effect for effect in system.effects if effect not in effects)})


def _exact(system: System) -> System | None:
    """The system with all its links exact, by effects that say so; None where there is no linear one."""
    links = places(system, ENTRIES["geometric_stiffening"].at)
    effects = tuple(Effect(name="geometric_stiffening", where=where) for where in links)
    declared = {(effect.name, effect.where) for effect in system.effects}
    fresh = tuple(effect for effect in effects if (effect.name, effect.where) not in declared)
    return system.model_copy(update={"effects": (*system.effects, *fresh)}) if fresh else None


def diagnose(
    system: System,
    blocks: Sequence[Block],
    source: str,
    prior: PriorOf,
    holdout: Sequence[Block] = (),
    progress: Callable[[str], None] = lambda message: None,
) -> Diagnosis:
    """Trace what a capture holds beyond its description, adopt it and fit again.

    blocks: samples of the capture; holdout: those of another one of the same rig, to check on. progress: is told what
    is being done. Raises InputError where a channel is missing or there is too little motion for any row.
    """
    progress("fitting the model as described")
    before, record = _session(system, blocks, source, prior)
    if before.momentum is None or before.momentum.sensor_noise is None:
        raise InputError(source, "", "too few samples to tell the sensors' noise", "a longer capture")
    segments = record.segments()
    held = _session(system, holdout, source, prior)[1].segments() if holdout else []
    progress("tracing what it leaves")
    attempt = described = Attempt(system, before, segments, held, prior)
    chosen = attempt.tracing.run()
    ranking = attempt.tracing.ranking()
    bare = described.state([])
    exact = _exact(system)
    if exact is not None and any(row.beyond for row in attempt.state(chosen).test.values()):
        progress("comparing exact links")
        beta = described.solution([])[: described.rows.base.n]
        forces = [attempt.tracing.candidates[k].effect for k in chosen[:1]]
        linear, other = (
            Attempt(each, before, segments, held, prior, beta, effects, SOME).excess(range(len(effects)))
            for each, effects in ((system, forces), (exact, []))
        )
        if other < linear:
            attempt = Attempt(exact, before, segments, held, prior, beta)
            chosen = attempt.tracing.run()
    while any(attempt.tracing.candidates[k].of_channel for k in chosen):
        progress("correcting channels")
        solution, n = attempt.solution(chosen), attempt.rows.base.n
        system_then, beta = attempt.adopted(chosen, solution), solution[:n]
        forces = [attempt.tracing.candidates[k].effect for k in chosen if not attempt.tracing.candidates[k].of_channel]
        improved = _without(system_then, forces)
        for _ in range(CORRECTIONS):
            fewer = Attempt(improved, before, segments, held, prior, beta, forces, SOME)
            solution = fewer.solution(range(len(forces)))
            improved, beta = fewer.increments(solution), solution[:n]
        corrected_keys = {(effect.name, effect.where) for effect in improved.effects}
        others = [c for c in attempt.tracing.candidates if (c.effect.name, c.effect.where) not in corrected_keys]
        attempt = Attempt(improved, before, segments, held, prior, beta, others)
        chosen = attempt.tracing.run()
    refine(attempt.tracing, attempt.make, chosen)
    after = attempt.state(chosen)
    progress("fitting the model with what was found")
    named = bool(after.system.effects != system.effects)
    estimator_after = _session(after.system, blocks, source, prior)[0] if named else before
    left = max(0.0, after.excess) / max(bare.excess, 1.0)
    beyond = any(row.beyond for row in after.test.values())
    verdict = "unexplained" if beyond and left > LARGEST_SHARE_LEFT else "named" if named else "clean"
    unexplained = None
    if verdict == "unexplained":
        unexplained = describe_residual(attempt.rows, attempt.tracing.columns(chosen), after.residual)
    findings = [attempt.tracing.finding(chosen, k) for k in chosen]
    return Diagnosis(verdict, findings, ranking, bare, after, before, estimator_after, unexplained)


def _session(system: System, blocks: Sequence[Block], source: str, prior: PriorOf) -> tuple[Estimator, SampleRecord]:
    estimator = Estimator(system, blocks[0].channels, source)
    record = SampleRecord(system.sample_rate)
    estimator.on_samples = record.add
    known = prior(estimator)
    if known is not None:
        estimator.set_prior(known)
    for block in blocks:
        estimator.push(block)
    estimator.finish()
    return estimator, record
