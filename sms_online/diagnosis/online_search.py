"""Which effect the last seconds of a running session hold: the search of a diagnosis over a bounded record.

An effect that began while the session ran has no trace before: its columns are zero in the windows of the samples
before, which give the parameters. Where nothing is named so, it may have been there all the time: the same columns once
more, in all windows. A search is a function of its request alone, so that it may be made in another process, or again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sms_online.description.schema import Effect, System
from sms_online.diagnosis.candidate import Candidate, Unmodelled
from sms_online.diagnosis.candidates import CandidateColumns
from sms_online.diagnosis.constants import corrected, improved, is_constant, possible
from sms_online.diagnosis.folds import Folds
from sms_online.diagnosis.hypothesis import (
    CORRECTIONS,
    LARGEST_SHARE_LEFT,
    REWEIGHED,
    Hypothesis,
    corrections,
    share_left,
    verdict,
)
from sms_online.diagnosis.late_sensors import LateSensor, find_late
from sms_online.diagnosis.record import bounded, excerpts
from sms_online.diagnosis.reported import of_constant, of_unknowns
from sms_online.diagnosis.residuals import ResidualTest
from sms_online.diagnosis.rows import SessionRows
from sms_online.diagnosis.searcher import REPORTED, AnyRequest, Named, Outcome, RecordedRequest, Request
from sms_online.diagnosis.weak_windows import WeakWindows
from sms_online.effects.build import build_model, declaring, with_effects
from sms_online.effects.catalogue import ENTRIES, declarable
from sms_online.model.parameters import Parameter
from sms_online.stream import Array
from sms_online.threads import one_blas_thread

# Windows that the effect acts in, in blocks of which each checks what the others say.
LEAST_WINDOWS = 12
# What takes less than this share of what the best effect takes is rather an error of that one's model, for real
# friction has no corner; else it is found once the others are in the model.
LEAST_SHARE = 0.01
# Times that rows are whitened in a search at most: one effect takes some fifteen, three some forty. A session that
# lacks more is for `diagnose`.
MOST_WHITENINGS = 80


class Immediate:
    """Every search, at once."""

    def __init__(self) -> None:
        self._done: tuple[int, Outcome | None] | None = None

    def submit(self, number: int, request: AnyRequest) -> bool:
        """See `Searcher`."""
        self._done = number, search(request)
        return True

    def outcome(self, block: int) -> tuple[int, Outcome | None] | None:
        """See `Searcher`."""
        done, self._done = self._done, None
        return done


class LateColumns(CandidateColumns):
    """Candidates that act from a segment on."""

    def __init__(
        self, rows: SessionRows, system: System, late: int, weak: WeakWindows | None = None, resting: bool = False
    ) -> None:
        super().__init__(rows, system, weak, resting=resting)
        self._late = late
        self._before = self._weak.windows.segment < late

    def _in(self, weak: WeakWindows, resting: bool) -> LateColumns:
        return LateColumns(self.rows, self.system, self._late, weak, resting)

    def of(self, effect: Effect) -> Candidate:
        """The candidate of one declaration."""
        return self.limited(super().of(effect))

    def limited(self, candidate: Candidate) -> Candidate:
        """The same without the windows before."""
        return replace(candidate, columns=np.where(self._before[:, None, None], 0.0, candidate.columns))

    def unmodelled(self, candidate: Candidate, coefficients: Array) -> Unmodelled:
        """Unmodelled covariance of the windows that it acts in."""
        whole = super().unmodelled(candidate, coefficients)
        acts = ~self._before[:, None, None]
        return Unmodelled(whole.own * acts[..., 0], whole.free * acts)


class _Bounded(Hypothesis):
    """A hypothesis whose search ends when it has taken long."""

    def watch(self, chosen: Sequence[int]) -> bool:
        """See `Hypothesis`."""
        return self.tracing.whitenings > MOST_WHITENINGS


@one_blas_thread()
def search(request: AnyRequest) -> Outcome | None:
    """Trace what the record holds beyond the model; None where it is too short, or its rows are degenerate."""
    if isinstance(request, RecordedRequest):
        # Sessions without the smoother need none of it.
        from sms_online.diagnosis.recorded_search import search_recorded

        return search_recorded(request)
    try:
        return _search(_bounded(request))
    except np.linalg.LinAlgError:
        return None


def _search(request: Request) -> Outcome | None:
    system = request.model.system
    rows = _rows(request, request.beta)
    late = rows.weak.windows.segment >= request.late
    if int(late.sum()) < LEAST_WINDOWS or rows.count * rows.model.layout.n_v < 2 * rows.base.n:
        return None
    everything = CandidateColumns(rows, system, since=request.late).all()
    some = _hypothesis(request, rows, everything, request.late)
    if request.late == 0 and np.any(some.tracing.floor) and (found := find_late(rows)) is not None:
        # Against a sensor that is far behind the others no force explains anything.
        return _of_late(found, request)
    outcome = _trace(request, some, everything, request.late)
    for _ in range(0 if request.whitened or outcome.ended else REWEIGHED):
        # Hardly anything was known of the rows' noise, for nothing explained the torques.
        rows.reweight(outcome.beta)
        outcome = _trace(request, _hypothesis(request, rows, everything, request.late), everything, request.late)
    if any(_needs_masses(named.effect) for named in outcome.named) and not outcome.ended:
        everything = _with_masses(request, rows, everything, outcome)
        outcome = _trace(request, _hypothesis(request, rows, everything, request.late), everything, request.late)
    if outcome.verdict != "unexplained" or request.late == 0 or outcome.ended:
        return outcome
    always = _trace(request, _hypothesis(request, rows, everything, 0), everything, 0)
    return always if always.verdict == "named" or always.left < outcome.left else outcome


def _needs_masses(effect: Effect) -> bool:
    return is_constant(effect) and ENTRIES[effect.name].kind != "channel"


def _with_masses(
    request: Request, rows: SessionRows, everything: Sequence[Candidate], outcome: Outcome
) -> list[Candidate]:
    """Candidates, with columns that hold masses as these are beside what was named: a tilt's are linear in them."""
    make = LateColumns(rows, request.model.system, request.late)
    beta = outcome.beta
    for _ in range(CORRECTIONS):
        rows.reweight(beta)
        named = [make.of(each.effect) for each in outcome.named]
        some = Hypothesis(make, named, _folds(rows, request.late), request.prior)
        some.tracing.reweight(some.everything)
        beta = some.solution(some.everything)[: rows.base.n]
    rows.reweight(beta)
    return [make.of(each.effect) if _needs_masses(each.effect) else each for each in everything]


def _of_late(found: LateSensor, request: Request) -> Outcome:
    """What a search says of a sensor that is late."""
    left = (found.after / found.before) ** 2
    named = Named(
        effect=found.effect,
        parameters=(),
        units=(),
        values=np.empty(0),
        stds=np.empty(0),
        coefficients={"corner": (found.corner, found.std, "Hz")},
        gain=found.gain,
        limit=found.limit,
        ambiguous=found.ambiguous,
    )
    said = "named" if left <= LARGEST_SHARE_LEFT else "unexplained"
    return Outcome(said, (named,), {named.key: found.gain}, left, False, request.beta)


def _bounded(request: Request) -> Request:
    """Stretches of the record, where its windows are so short that it holds too many of them."""
    length, most = bounded(request.model.system)
    before = excerpts(request.segments[: request.late], length, most // 3)
    after = excerpts(request.segments[request.late :], length, most - most // 3)
    return replace(request, segments=(*before, *after), late=len(before))


def _rows(request: Request, beta: Array, late: int = 0, constants: Sequence[Effect] = ()) -> SessionRows:
    """Rows of the record, the late segments free of what these constants do to channels."""
    system, channels = request.model.system, request.sensing.channels
    described = with_effects(system, constants)
    segments = [
        corrected(described if number >= late else system, channels, segment)
        for number, segment in enumerate(request.segments)
    ]
    return SessionRows(request.model, request.base, request.sensing, request.noise, segments, beta)


def _folds(rows: SessionRows, late: int) -> Folds:
    """Blocks of the windows that the effect acts in; all those before are fitted always."""
    segment = rows.weak.windows.segment
    return Folds.of(segment, rows.time, segment >= late)


def _hypothesis(request: Request, rows: SessionRows, everything: Sequence[Candidate], late: int) -> Hypothesis:
    """That some of the candidates act from a segment on."""
    make = LateColumns(rows, request.model.system, late)
    limited = [make.limited(candidate) for candidate in everything]
    return _Bounded(make, [c for c in limited if np.any(c.columns)], _folds(rows, late), request.prior)


def _trace(request: Request, some: Hypothesis, everything: Sequence[Candidate], late: int) -> Outcome:
    """One search, for effects that act from a segment on."""
    system, rows, tracing = request.model.system, some.rows, some.tracing
    ranking = tracing.ranking()[:REPORTED]
    chosen = some.run()
    ended = some.watch(chosen)
    findings = [tracing.finding(chosen, k) for k in chosen]
    gains = {k: finding.gain.gain for k, finding in zip(chosen, findings, strict=True)}
    kept = [k for k in chosen if gains[k] >= LEAST_SHARE * max(gains.values())]
    if channels := [k for k in kept if ENTRIES[tracing.candidates[k].effect.name].kind == "channel"]:
        # One at a time, for its column is a first approximation: what others take is known once it has been subtracted.
        best = max(channels, key=lambda k: gains[k])
        kept = [*(k for k in kept if k not in channels), best]
    if kept != chosen:
        tracing.reweight(kept)
        chosen, findings = kept, [tracing.finding(kept, k) for k in kept]
    before = some.excess([])
    final, used, constants = some, chosen, list[Effect]()
    if channels:
        final, constants = _corrected(request, some, chosen, late)
        used = list(final.everything)
        if not possible(constants[0], system.sample_rate):
            key = tracing.candidates[chosen[-1]].key
            others = [candidate for candidate in everything if candidate.key != key]
            return _trace(request, _hypothesis(request, rows, others, late), others, late)
    left = share_left(before, final.excess(used))
    test = ResidualTest(final.rows).of(final.residual(used))
    candidates = [final.tracing.candidates[k] for k in used]
    places = final.places(candidates)
    # A constant was found last.
    effects = [*(candidate.effect for candidate in candidates), *constants]
    places = [*places[len(constants) :], *places[: len(constants)]]
    solution, covariance = final.solution(used), final.tracing.covariance(used)
    stds = np.sqrt(np.diag(covariance))
    named = []
    for finding, effect, own in zip(findings, effects, places, strict=True):
        parameters = () if effect in constants else finding.candidate.parameters
        unknown = own if parameters else slice(0)
        named.append(
            Named(
                effect=improved(effect, solution[own]) if parameters and is_constant(effect) else effect,
                parameters=tuple(p.name for p in parameters),
                units=tuple(p.unit for p in parameters),
                values=solution[unknown],
                stds=stds[unknown],
                coefficients=_coefficients(request, solution, covariance, effect, parameters, own),
                gain=finding.gain.gain,
                limit=finding.limit,
                ambiguous=finding.ambiguous,
            )
        )
    scores = {ranked.candidate.key: ranked.gain for ranked in ranking}
    said = "unexplained" if ended else verdict(bool(chosen), left, test)
    return Outcome(said, tuple(named), scores, left, late > 0, solution[: rows.base.n], ended)


def _corrected(request: Request, some: Hypothesis, chosen: Sequence[int], late: int) -> tuple[Hypothesis, list[Effect]]:
    """The same effects, with the readings free of the last one, a channel's, and its constants improved."""
    solution = some.solution(chosen)
    candidates = [some.tracing.candidates[k] for k in chosen]
    *forces, last = (candidate.effect for candidate in candidates)
    constant = improved(last, solution[some.places(candidates)[-1]])

    def trial(constants: Sequence[Effect], beta: Array) -> Hypothesis:
        rows = _rows(request, beta, late, constants)
        make = LateColumns(rows, with_effects(request.model.system, constants), late)
        trial = Hypothesis(make, [make.of(force) for force in forces], _folds(rows, late), request.prior, constants)
        trial.tracing.reweight(trial.everything)
        return trial

    *_, best = corrections(trial, [constant], solution[: request.base.n])
    return best.hypothesis, best.constants


def _coefficients(
    request: Request, solution: Array, covariance: Array, effect: Effect, parameters: Sequence[Parameter], own: slice
) -> dict[str, tuple[float, float | None, str]]:
    """What people read of an effect; parameters: none of a constant."""
    system, base = request.model.system, request.base
    units = declarable(ENTRIES[effect.name], system)
    if parameters:
        declared = declaring(system, [effect])
        model = build_model(declared, base.physical_values(solution[: base.n]))
        known = [*range(base.n), *range(own.start, own.stop)]
        names = [p.name for p in (*base.parameters, *parameters)]
        reported = of_unknowns(effect, parameters, model, names, solution[known], covariance[np.ix_(known, known)])
        units = {p.quantity: p.unit for p in parameters} | units
    else:
        reported = of_constant(effect, covariance[own, own])
    return {name: (value, std, units.get(name, "")) for name, (value, std) in reported.items()}
