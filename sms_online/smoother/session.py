"""The smoother of a session: samples gathered into spans, each fitted with the spans before it as its prior."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from sms_online.calibration.nuisance import Nuisance
from sms_online.description.schema import TrackerChoice
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.model.readings import readable_channels
from sms_online.physical import PhysicalSet
from sms_online.pipeline.events import Event, prior_behind
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import FEWEST_SAMPLES
from sms_online.pipeline.tracker_bank import Reading
from sms_online.smoother.changes import SpanChanges, Step, contradicts
from sms_online.smoother.fit import SpanSmoother
from sms_online.smoother.gatherer import Gatherer
from sms_online.smoother.gauss_newton import DivergedError
from sms_online.smoother.noise import SpanNoise
from sms_online.smoother.problem import SpanProblem
from sms_online.smoother.search import LARGEST_MEAN_SQUARE, SpanFit
from sms_online.smoother.span import Ending, Span
from sms_online.smoother.statistics import SmootherStatistics
from sms_online.smoother.tracking import SpanTrackers
from sms_online.state import Stage, State
from sms_online.stream import Array
from sms_online.trackers.factor import triangular_factor
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Estimate, Prior

# Length of the first span, and of one behind a gap, s: long enough to determine the parameters from a poor first fit.
SPAN = 10.0
# Of one that goes on from the last, whose state it knows: nothing is lost where spans meet, and nobody waits longer.
NEXT_SPAN = 1.0
# A shorter one may not hold a motion.
LEAST_SPAN = 0.5
# Of the span behind a change, s, and where that does not show what it was.
BEHIND, LONGEST_BEHIND = 3.0, 6.0
# Spans that are left out for a change: the one that shows it, and the one before, which it may have disturbed.
LEFT_OUT = 2
# Where parameters may move, a span is fitted beside what is known of them with deviations that are so many times as
# large: its rows do not depend on that, but what its samples leave would be larger than noise.
LOOSER = 10.0


class SmootherState(State):
    """What a smoother keeps of the spans so far.

    known: from the spans so far; before: without the last one, which a change may have disturbed. ending: of the span
    that the next one goes on from, None where there is none. change: begin and end of the span that contradicts those
    before it, s, None without one; wanted: length of the span behind it, s. events: so far; added: names of the
    parameters that they have added.
    """

    known: SmootherStatistics
    before: SmootherStatistics
    ending: Ending | None = None
    change: tuple[float, float] | None = None
    wanted: float = BEHIND
    events: list[Event] = msgspec.field(default_factory=list)
    added: list[str] = msgspec.field(default_factory=list)


class Smoother(Stage):
    """Estimates the base parameters of a session from all its samples and the equations of motion.

    It works span by span: a span's rows of independent unit errors join those of the spans before it. channels: of the
    readings that it uses, see `sensor_set.Readings`. prior: what is known beforehand of the parameters as described, or
    None. trackers: those that are chosen, the judged one first: the next span is fitted beside what it knows. changed:
    called where other parameters come to be estimated behind a change; None where it is not to look for any.
    """

    def __init__(
        self, model: Model, base: BaseParameters, sensing: Sensing, available: Sequence[str],
        trackers: Sequence[TrackerChoice], changed: Callable[[], None] | None,
    ) -> None:  # fmt: skip
        self._rate = model.system.sample_rate
        self.channels = tuple(name for name in readable_channels(model) if name in available)
        self.prior: Prior | None = None
        self.gathered = Gatherer(model, len(self.channels))
        self._noise = SpanNoise(model, sensing, self.channels)
        self._choices, self._changed = tuple(trackers), changed
        # Where parameters may move anyway, nothing jumps.
        self._watches = changed is not None and trackers[0].static
        self._problem = SpanProblem(model, base, sensing, self.channels)
        self._changes = SpanChanges(self._problem, sensing, self.channels)
        self.trackers = self._new_trackers()
        nothing = SmootherStatistics.none(np.array([each.tolerance for each in self.nuisances]), base.n)
        self.state = SmootherState(nothing, nothing)

    def renew(self) -> None:
        """See Stage."""
        if self.state.added:
            self._problem = self._changes.problem(self.state.added)
            self.trackers = self._new_trackers()
        if self.state.events and self._changed is not None:
            self._changed()

    def set_prior(self, prior: Prior) -> None:
        """Add what is known of the base parameters beforehand as a prior; before the first sample."""
        self.prior = prior
        self.trackers = self._new_trackers()

    def _new_trackers(self) -> SpanTrackers:
        name, parameters = self.model.system.name, self.base.parameters
        return SpanTrackers(self._choices, name, parameters, self.nuisances, self.current_prior, NEXT_SPAN)

    @property
    def model(self) -> Model:
        """The model, with what events have added."""
        return self._problem.model

    @property
    def base(self) -> BaseParameters:
        """The parameters that are estimated, with what events have added."""
        return self._problem.base

    @property
    def events(self) -> list[Event]:
        """Changes of the system so far."""
        return self.state.events

    @property
    def nuisances(self) -> tuple[Nuisance, ...]:
        """What its readings may be off by."""
        return self._problem.readings.all

    @property
    def current_prior(self) -> Prior | None:
        """What is known beforehand of the current parameters."""
        return None if self.prior is None else prior_behind(self.state.events, self.prior, self.base.parameters)

    @property
    def end(self) -> float:
        """Time of the newest sample behind the estimate, s; -inf where there is none."""
        return self.known.end

    @property
    def known(self) -> SmootherStatistics:
        """From the spans so far."""
        return self.state.known

    def resume(self, end: float) -> None:
        """Count nothing as lost from `end`, s, to the next sample: the session did not listen."""
        self.gathered.resume(end)

    def work(self, first_fit: Callable[[], Estimate], last: bool = False) -> None:
        """Fit the spans that are complete; `last` at the end of the session.

        first_fit: gives an estimate to begin with, until a span has one.
        """
        if last:
            self.gathered.finish()
        while (count := self.gathered.complete(self._length, last)) > 0:
            if count <= max(LEAST_SPAN * self._rate, FEWEST_SAMPLES):
                self.state.ending = None
            elif not self._fit(count, first_fit):
                continue
            if not self.gathered.forget(count):
                self.state.ending = None
        if last and self.state.change is not None:
            self._add_event("undecided", self.state.change)

    @property
    def _length(self) -> int:
        """Torque samples of the next span."""
        length = SPAN if self.state.ending is None else NEXT_SPAN
        if self.state.change is not None:
            length = self.state.wanted
        return max(round(length * self._rate), FEWEST_SAMPLES) + 1

    def _fit(self, count: int, first_fit: Callable[[], Estimate]) -> bool:
        """Fit a span; whether that is done, and no more samples are wanted for it."""
        now = self.state
        if now.change is not None:
            step = self._step(count)
            if not (count < self._length or now.wanted >= LONGEST_BEHIND or (step is not None and step.clear)):
                now.wanted = LONGEST_BEHIND
                return False
            if self._goes_on(step, count, first_fit):
                return True
        fit = self._fitted(count, first_fit)
        if self._doubtful(fit) and self._noise.shows_more(self.gathered, count):
            # The samples show more noise than is stated.
            now.known = self.known._replace(noisier=self._noise.state.noisier)
            fit = self._fitted(count, first_fit)
        begin, end, _, _ = self.gathered.span(count)
        if self._settled and contradicts(self._beforehand, fit):
            now.change, now.wanted = (begin, end), BEHIND
            now.known, now.ending = now.before, None
        elif isinstance(fit, SpanFit):
            self._take(fit, begin, end)
        else:
            failures = (*self.known.failures, f"{begin:.6g} … {end:.6g} s: {fit}")
            now.known, now.ending = self.known._replace(failures=failures), None
        return True

    @property
    def _settled(self) -> bool:
        """Whether a span that does not agree with those before it shows a change."""
        return self._watches and bool(self.known.spans) and self.known.exact

    def _doubtful(self, fit: SpanFit | DivergedError) -> bool:
        if isinstance(fit, DivergedError):
            return True
        return fit.mean_square > LARGEST_MEAN_SQUARE or fit.torque_noise > self.known.torque_noise

    def _fitted(self, count: int, first_fit: Callable[[], Estimate]) -> SpanFit | DivergedError:
        """Fit of the first `count` torques; or why there is none."""
        past = self.known
        try:
            smoother, span = self._span_problem(count)
            beta = past.beta if np.isfinite(past.beta).all() else self._beginning(first_fit)
            last_step = past.last_step if np.isfinite(past.last_step) else None
            return smoother.fit(span, beta, self._beforehand, last_step, self.state.ending, self._settled)
        except DivergedError as error:
            return error

    def _span_problem(self, count: int) -> tuple[SpanSmoother, Span]:
        """What fits the first `count` torques, and their span; DivergedError where there is no motion to begin with."""
        noise = self._noise(self.gathered, count, goes_on=self.state.ending is not None)
        return self._problem(self.gathered, count, *noise, self.known.torque_noise)

    @property
    def _beforehand(self) -> Array:
        """What is known of nuisances and parameters before a span, as a factor (m + n + 1, m + n + 1)."""
        tracked = self.trackers.factor
        past = self.known.factor if tracked is None else tracked / LOOSER
        return triangular_factor(self.known.beforehand(self.current_prior), past)

    def _beginning(self, first_fit: Callable[[], Estimate]) -> Array:
        """β (m + n,) of the physically consistent parameters nearest to a first fit; DivergedError where none are."""
        estimate = first_fit()
        variance = estimate.rss / estimate.dof if estimate.scale is None and estimate.dof > 0.0 else 1.0
        covariance = np.where(np.isfinite(estimate.covariance), estimate.covariance * max(variance, 1.0), np.inf)
        try:
            found = PhysicalSet(self.model, self.base).project(estimate.pi, covariance)
        except ArithmeticError as error:
            raise DivergedError(str(error)) from None
        return np.concatenate((np.zeros(len(self.nuisances)), found.beta))

    def _take(self, fit: SpanFit, begin: float, end: float) -> None:
        now = self.state
        now.before, now.ending = now.known, fit.ending
        now.known = now.known.with_span(fit, end, self.gathered.lost, self.current_prior)
        self.trackers.update(fit, 0.5 * (begin + end))

    def _goes_on(self, step: Step | None, count: int, first_fit: Callable[[], Estimate]) -> bool:
        """Go on behind a change with the step that explains it best, or anew; whether the span is taken already."""
        now, past, change = self.state, self.known, self.state.change
        assert change is not None
        now.change = None
        if step is not None and not step.explanation.needed:
            # It did not last.
            failure = f"{change[0]:.6g} … {change[1]:.6g} s: samples agree with those before and behind, not there"
            now.known = past._replace(failures=(*past.failures, failure))
            return False
        if step is not None and step.explains and self._adopt(step, change, count, first_fit):
            return True
        self._add_event("unexplained", change)
        nothing = SmootherStatistics.none(past.tolerances, self.base.n)
        now.known = nothing._replace(beta=past.beta, failures=past.failures, noisier=past.noisier)
        self._begin_behind()
        return False

    def _step(self, count: int) -> Step | None:
        """The step that explains a span behind a change best; None where no parameters explain it."""
        try:
            noise = (*self._noise(self.gathered, count, goes_on=False), self.known.torque_noise)
            known = self._beforehand, self.known.beta
            return self._changes.explain(self.gathered, count, noise, known, self._problem, self.state.added)
        except DivergedError:
            return None

    def _adopt(self, step: Step, change: tuple[float, float], count: int, first_fit: Callable[[], Estimate]) -> bool:
        """Go on with parameters that have jumped, from the span behind it; whether its samples agree with that."""
        now, problem, past, prior = self.state, self._problem, self.known, self.current_prior
        added = [*now.added, *step.fresh]
        self._problem = self._changes.problem(added)
        names = [p.name for p in self.base.parameters]
        jumped = [len(self.nuisances) + names.index(name) for name in step.names]
        beta = np.concatenate((step.explanation.beta, np.zeros(len(step.fresh))))
        beta[jumped] += step.explanation.sizes
        known = Information(past.factor, past.rows).widened(len(step.fresh)).without(jumped)
        # With what is carried modes are faster, and may need finer steps.
        now.known = past._replace(factor=known.factor, beta=beta, blocks=(), last_step=np.nan)
        self._add_event(step.kind, change, step.names)
        fit = self._fitted(count, first_fit)
        if isinstance(fit, DivergedError) or contradicts(self._beforehand, fit):
            self._problem, now.known, now.events = problem, past, now.events[:-1]
            return False
        now.added = added
        self._begin_behind()
        begin, end, _, _ = self.gathered.span(count)
        self._take(fit, begin, end)
        now.before = now.known
        self._measure(past.estimate(prior))
        return True

    def _begin_behind(self) -> None:
        if self._changed is not None:
            self._changed()
        self.trackers = self._new_trackers()
        self.trackers.begin(Information(self.known.factor, self.known.rows))

    def _add_event(self, kind: str, change: tuple[float, float], names: tuple[str, ...] = ()) -> None:
        event = Event(0.5 * (change[0] + change[1]), kind, names, (), (), (), LEFT_OUT)
        self.state.events = [*self.state.events, event]

    def _measure(self, before: Estimate) -> None:
        """Add to the last event by how much its parameters are other than in an estimate from before it."""
        now, event = self.known.estimate(self.current_prior), self.state.events[-1]
        # There was nothing of what is new.
        value, std = (np.pad(each, (0, now.pi.size - each.size)) for each in (before.pi, before.std))
        columns = [[p.name for p in self.base.parameters].index(name) for name in event.parameters]
        measured = replace(
            event,
            units=tuple(self.base.parameters[k].unit for k in columns),
            sizes=tuple((now.pi - value)[columns].tolist()),
            stds=tuple(np.hypot(now.std, std)[columns].tolist()),
        )
        self.state.events = [*self.state.events[:-1], measured]

    def estimate(self) -> Estimate:
        """The base parameters as the judged tracker knows them now, with the prior; only after the first span."""
        readings = self.readings()
        return readings[0].estimate if readings else self.known.estimate(self.current_prior)

    def readings(self) -> tuple[Reading, ...]:
        """Each chosen tracker's estimate, the judged one first; empty where that is its own least squares alone."""
        return self.trackers.readings(self.known.estimate(self.current_prior)) if self.trackers.any else ()
