"""The smoother of a session: samples gathered into spans, each fitted with the spans before it as its prior."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from sms_online.calibration.nuisance import Nuisance
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.model.readings import Readings, readable_channels
from sms_online.physical import PhysicalSet
from sms_online.pipeline.noise import noise_std
from sms_online.pipeline.sensing import Sensing, stated_noise
from sms_online.pipeline.sensor_noise import FEWEST_SAMPLES, SAMPLES
from sms_online.pipeline.synchronise import GridSamples, Synchroniser
from sms_online.smoother.first_motion import FirstMotion
from sms_online.smoother.fit import SpanSmoother
from sms_online.smoother.jackknife import SpanBlock, jackknife_covariance, with_span
from sms_online.smoother.nuisances import ReadingNuisances
from sms_online.smoother.search import LARGEST_MEAN_SQUARE, DivergedError, SpanFit
from sms_online.smoother.span import Ending, Span
from sms_online.state import Stage, State
from sms_online.stream import Array, Block, Indices
from sms_online.trackers.factor import solve, triangular_factor
from sms_online.trackers.interface import Estimate, Prior, prior_factor

# Length of the first span, and of one behind a gap, s: long enough to determine the parameters from a poor first fit.
SPAN = 10.0
# Of one that goes on from the last, whose state it knows: nothing is lost where spans meet, and nobody waits longer.
NEXT_SPAN = 1.0
# Where a gap of the motion is at its end, it goes on to the end of the gap, at most for this time, s.
LATER_END = 5.0
# A shorter one may not hold a motion.
LEAST_SPAN = 0.5
# Readings that scatter by this multiple of their stated noise hold more than that: a tenth more and no fit is taken.
NOISIER = 1.05
# No channel is better than this share of its largest reading: the collocation errs by as much.
FINEST = 1e-6


class SmootherStatistics(NamedTuple):
    """What the spans so far have determined; nothing in it changes as the session goes on.

    failures: spans that were left out and why, a sentence each. spans, rows: how many were taken. mean_square, level,
    torque_noise: the largest of all, see `SpanFit`. factor (m + n + 1, m + n + 1): square-root information about
    beta (m + n,), nuisances and parameters; tolerances (m,): of the nuisances.
    last_step: of the last fit. end: time of the newest sample, s. lost: samples without a torque. noisier:
    channels whose samples show more noise than is stated, and how many times as much, where no fit is taken otherwise.
    blocks: of spans, in order of time. scatter (m + n, m + n): covariance of β by what these scatter by, where samples
    do not agree with the equations and there are blocks enough.
    """

    failures: tuple[str, ...]
    spans: int
    level: float
    mean_square: float
    factor: Array
    beta: Array
    rows: int
    rss: float
    last_step: float
    end: float
    lost: int
    tolerances: Array
    torque_noise: float = 1.0
    noisier: tuple[tuple[str, float], ...] = ()
    blocks: tuple[SpanBlock, ...] = ()
    scatter: Array | None = None

    @property
    def exact(self) -> bool:
        """Whether samples agree with the equations of motion, and nothing had to be allowed for."""
        return self.beyond == 1.0 and self.torque_noise == 1.0 and self.level == 0.0

    @property
    def beyond(self) -> float:
        """The innovations' standard deviation over that of their noise, of the worst span; 1 where that is noise."""
        return float(np.sqrt(self.mean_square)) if self.mean_square > LARGEST_MEAN_SQUARE else 1.0

    def beforehand(self, prior: Prior | None) -> Array:
        """What is known of nuisances and parameters beforehand, as rows (·, m + n + 1)."""
        m, n = self.tolerances.size, self.beta.size - self.tolerances.size
        known = prior_factor(prior, n)
        within = np.zeros((m, m + n + 1))
        within[:, :m] = np.diag(1.0 / self.tolerances)
        return np.concatenate((within, np.concatenate((np.zeros((len(known), m)), known), axis=1)))

    def estimate(self, prior: Prior | None) -> Estimate:
        """The base parameters, with what is known of them beforehand; only after the first span."""
        n = self.beta.size
        problem = triangular_factor(self.beforehand(prior), self.factor)
        problem[:, n] -= problem[:, :n] @ self.beta
        solution = solve(problem)
        estimate = Estimate(
            pi=self.beta.copy(),
            covariance=solution.covariance(),
            covariance_robust=self.scatter,
            determined=solution.determined,
            condition_number=solution.condition_number,
            rows=float(self.rows),
            rss=self.rss,
            dof=max(float(self.rows - solution.rank), 0.0),
        )
        return estimate.without_nuisances(self.tolerances.size)


class SmootherState(State):
    """What a smoother keeps of the spans so far and to come.

    known: from the spans so far. values (B, channels): readings at t (B,), s. torque (K, joints): at index (K, 2), grid
    index and segment. motion (M, n_x + n_v): as the pipeline took it from the sensors, at grid indices `moved`. ending:
    of the span that the next one goes on from, None where there is none. sigma (channels,): noise of the last span's
    readings, NaN where it is not known.
    """

    known: SmootherStatistics
    t: Array
    values: Array
    index: Indices
    torque: Array
    moved: Indices
    motion: Array
    sigma: Array
    ending: Ending | None = None


class Smoother(Stage):
    """Estimates the base parameters of a session from all its samples and the equations of motion.

    It works span by span: a span's rows of independent unit errors join those of the spans before it. channels: of the
    readings that it uses, see `sensor_set.Readings`. prior: what is known beforehand, or None.
    """

    def __init__(self, model: Model, base: BaseParameters, sensing: Sensing, available: Sequence[str]) -> None:
        self._model, self._base, self._sensing = model, base, sensing
        self._rate, joints = model.system.sample_rate, len(model.system.joints)
        self.channels = tuple(name for name in readable_channels(model) if name in available)
        self.prior: Prior | None = None
        self._synchroniser = Synchroniser([f"n_tau_{i}" for i in range(1, joints + 1)], self._rate)
        self._readings = ReadingNuisances(model, self.channels)
        self._first_motion = FirstMotion(model, sensing, self.channels)
        tolerances = np.array([each.tolerance for each in self.nuisances])
        n = tolerances.size + base.n
        nothing = np.zeros((n + 1, n + 1)), np.full(n, np.nan)
        self.state = SmootherState(
            known=SmootherStatistics((), 0, np.nan, np.nan, *nothing, 0, 0.0, np.nan, -np.inf, 0, tolerances),
            t=np.empty(0),
            values=np.empty((0, len(self.channels))),
            index=np.empty((0, 2), dtype=np.int64),
            torque=np.empty((0, joints)),
            moved=np.empty(0, dtype=np.int64),
            motion=np.empty((0, model.layout.n_x + model.layout.n_v)),
            sigma=np.full(len(self.channels), np.nan),
        )

    def set_prior(self, prior: Prior) -> None:
        """Add what is known of the base parameters beforehand as a prior; before the first sample."""
        self.prior = prior

    def resume(self, end: float) -> None:
        """Count nothing as lost from `end`, s, to the next sample: the session did not listen."""
        self._synchroniser.resumed = end

    @property
    def nuisances(self) -> tuple[Nuisance, ...]:
        """What its readings may be off by."""
        return self._readings.all

    @property
    def end(self) -> float:
        """Time of the newest sample behind the estimate, s; -inf where there is none."""
        return self.known.end

    @property
    def known(self) -> SmootherStatistics:
        """From the spans so far."""
        return self.state.known

    def push(self, t: Array, torque: Array, values: Array) -> None:
        """Take samples at t (B,), s, in order of time: n τ (B, joints), readings (B, channels), else NaN."""
        now = self.state
        now.t, now.values = np.concatenate((now.t, t)), np.concatenate((now.values, values))
        for piece in self._synchroniser.push(Block(t, self._synchroniser.channels, torque)):
            self._keep(piece)

    def _keep(self, piece: GridSamples) -> None:
        now = self.state
        index = np.stack((piece.index, np.full(piece.index.size, piece.segment)), axis=1)
        now.index, now.torque = np.concatenate((now.index, index)), np.concatenate((now.torque, piece.values))

    def move(self, index: Indices, x: Array, v: Array) -> None:
        """Take the motion as the sensors alone give it, at grid samples (B,): x (B, n_x), v (B, n_v)."""
        now = self.state
        now.moved = np.concatenate((now.moved, index))
        now.motion = np.concatenate((now.motion, np.concatenate((x, v), axis=1)))

    def work(self, first_fit: Callable[[], Estimate], last: bool = False) -> None:
        """Fit the spans that are complete; `last` at the end of the session.

        first_fit: gives an estimate to begin with, until a span has one.
        """
        if last:
            for piece in self._synchroniser.flush():
                self._keep(piece)
        while (count := self._complete(last)) > 0:
            end = int(self.state.index[count - 1, 0])
            if not last and not (self.state.moved.size and self.state.moved[-1] >= end):
                return
            if count > max(LEAST_SPAN * self._rate, FEWEST_SAMPLES):
                self._fit(count, first_fit)
            else:
                self.state.ending = None
            self._forget(count)

    def _complete(self, last: bool) -> int:
        """Torque samples of the first span, 0 where more of them may come."""
        segment = self.state.index[:, 1]
        run = int(np.searchsorted(segment, segment[0], side="right")) if segment.size else 0
        length = SPAN if self.state.ending is None else NEXT_SPAN
        longest = max(round(length * self._rate), FEWEST_SAMPLES) + 1
        most = longest + round(LATER_END * self._rate)
        if run < longest:
            return run if last or run < segment.size else 0
        # A span ends, and the next one begins, where the motion is known: a first state that is guessed rings.
        known = np.flatnonzero(np.isin(self.state.index[longest - 1 : min(run, most), 0], self.state.moved))
        if known.size:
            return longest + int(known[0])
        moved = self.state.moved[-1] if self.state.moved.size else -1
        over = last or run < segment.size or (run >= most and moved >= self.state.index[most - 1, 0])
        return longest if over else 0

    def _time(self, index: Indices) -> Array:
        return np.asarray(self._synchroniser.start_time + index / self._rate)

    def _forget(self, count: int) -> None:
        """Drop a span; the sample that ends it begins the next one, if there is no gap between them."""
        now = self.state
        goes_on = count < len(now.index) and now.index[count, 1] == now.index[count - 1, 1]
        dropped = count - 1 if goes_on else count
        if not goes_on:
            now.ending = None
        end = now.index[count - 1, 0]
        now.index, now.torque = now.index[dropped:], now.torque[dropped:]
        kept = now.t > self._time(end)
        now.t, now.values = now.t[kept], now.values[kept]
        kept = now.moved >= end
        now.moved, now.motion = now.moved[kept], now.motion[kept]

    def _fit(self, count: int, first_fit: Callable[[], Estimate]) -> None:
        """Fit a span; once more where it does not agree with its samples, and these show more noise than is stated."""
        now = self.state
        begin, end, t, values = self._samples(count)
        fit = self._fitted(count, t, values, first_fit)
        if self._doubtful(fit) and self._noisier(t, values):
            fit = self._fitted(count, t, values, first_fit)
        if isinstance(fit, SpanFit):
            now.ending = fit.ending
            self._take(fit, end)
        else:
            failures = (*now.known.failures, f"{begin:.6g} … {end:.6g} s: {fit}")
            now.known, now.ending = now.known._replace(failures=failures), None

    def _samples(self, count: int) -> tuple[float, float, Array, Array]:
        """Begin and end of the span of `count` torques, s, and t (M,) and values (M, channels) of its readings."""
        now = self.state
        begin, end = self._time(now.index[[0, count - 1], 0]).tolist()
        inside = (now.t >= begin) & (now.t <= end)
        return begin, end, now.t[inside], now.values[inside]

    def _doubtful(self, fit: SpanFit | DivergedError) -> bool:
        if isinstance(fit, DivergedError):
            return True
        return fit.mean_square > LARGEST_MEAN_SQUARE or fit.torque_noise > self.known.torque_noise

    def _fitted(
        self, count: int, t: Array, values: Array, first_fit: Callable[[], Estimate]
    ) -> SpanFit | DivergedError:
        """Fit of the first `count` torques and of readings (M, channels) at t (M,), s; or why there is none."""
        past = self.known
        try:
            smoother, span = self._problem(count, t, values)
            beta = past.beta if past.spans else self._beginning(first_fit)
            last_step = past.last_step if past.spans else None
            return smoother.fit(span, beta, self._beforehand, last_step, self.state.ending)
        except DivergedError as error:
            return error

    @property
    def _beforehand(self) -> Array:
        """What is known of nuisances and parameters before a span, as a factor (m + n + 1, m + n + 1)."""
        return triangular_factor(self.known.beforehand(self.prior), self.known.factor)

    def _beginning(self, first_fit: Callable[[], Estimate]) -> Array:
        """β (m + n,) that the first span begins with; DivergedError where it is no mechanism's."""
        return np.concatenate((np.zeros(len(self.nuisances)), self._realisable(first_fit())))

    def _problem(self, count: int, t: Array, values: Array) -> tuple[SpanSmoother, Span]:
        """What fits a span, and the span: see `_fitted`. DivergedError where there is no motion to begin with."""
        now = self.state
        torque_t = self._time(now.index[:count, 0])
        moved = (now.moved >= now.index[0, 0]) & (now.moved <= now.index[count - 1, 0])
        sigma, torque_density = self._noise(t, values, now.torque[:count])
        sensed = np.flatnonzero(np.isfinite(sigma))
        readings = Readings(self._model, [self.channels[k] for k in sensed])
        noise = sigma[sensed], torque_density
        of_channels = self._readings, sensed.tolist()
        smoother = SpanSmoother(self._model, self._base, readings, *noise, *of_channels, self.known.torque_noise)
        if not moved.any():
            raise DivergedError("the sensors give no motion to begin with")
        guess = self._first_motion(self._time(now.moved[moved]), now.motion[moved], t, values)
        return smoother, Span(torque_t, now.torque[:count], t, values[:, sensed], *guess)

    def _take(self, fit: SpanFit, end: float) -> None:
        past = self.state.known
        known = SmootherStatistics(
            failures=past.failures,
            spans=past.spans + 1,
            level=float(np.fmax(past.level, fit.level)),
            mean_square=float(np.fmax(past.mean_square, fit.mean_square)),
            factor=triangular_factor(past.factor, fit.factor),
            beta=fit.beta,
            rows=past.rows + fit.rows,
            rss=past.rss + fit.rows * fit.mean_square,
            last_step=fit.step,
            end=end,
            lost=self._synchroniser.counters.lost_samples,
            tolerances=past.tolerances,
            torque_noise=max(past.torque_noise, fit.torque_noise),
            noisier=past.noisier,
            blocks=with_span(past.blocks, fit.rows, fit.factor),
        )
        # Here, as it takes a solution for each block, and estimates are asked for more often than spans end.
        scatter = None if known.exact else jackknife_covariance(known.blocks, known.beforehand(self.prior))
        self.state.known = known._replace(scatter=scatter)

    def _noisier(self, t: Array, values: Array) -> bool:
        """Whether samples (M, channels) at t (M,) show more noise than is taken so far; then that is taken."""
        stated, times = stated_noise(self._model.system, self.channels), dict(self.known.noisier)
        found = dict(times)
        for k in np.flatnonzero(np.isfinite(stated)):
            name, own = self.channels[k], np.flatnonzero(np.isfinite(values[:, k]))[-SAMPLES:]
            if own.size >= FEWEST_SAMPLES:
                shown = float(noise_std(values[own, k][:, None], t[own])[0] / stated[k])
                if shown > NOISIER * times.get(name, 1.0):
                    found[name] = shown
        self.state.known = self.known._replace(noisier=tuple(found.items()))
        return found != times

    def _realisable(self, estimate: Estimate) -> Array:
        """β (n,) of the physically consistent parameters nearest to an estimate."""
        variance = estimate.rss / estimate.dof if estimate.scale is None and estimate.dof > 0.0 else 1.0
        covariance = np.where(np.isfinite(estimate.covariance), estimate.covariance * max(variance, 1.0), np.inf)
        try:
            return PhysicalSet(self._model, self._base).project(estimate.pi, covariance).beta
        except ArithmeticError as error:
            raise DivergedError(str(error)) from None

    def _noise(self, t: Array, values: Array, torque: Array) -> tuple[Array, Array]:
        """Noise of samples at t (channels,), NaN where nothing is known of it, and the torques' density (joints,)."""
        times = dict(self.known.noisier)
        sigma = stated_noise(self._model.system, self.channels) * [times.get(name, 1.0) for name in self.channels]
        if self.state.ending is not None:
            # A short span has too few samples of a slow channel.
            sigma = np.where(np.isnan(sigma), self.state.sigma, sigma)
        for k in np.flatnonzero(np.isnan(sigma)):
            own = np.flatnonzero(np.isfinite(values[:, k]))[-SAMPLES:]
            if own.size >= FEWEST_SAMPLES:
                sigma[k] = noise_std(values[own, k][:, None], t[own])[0]
        self.state.sigma = sigma
        largest = np.max(np.abs(values), axis=0, initial=0.0, where=np.isfinite(values))
        sigma = np.maximum(sigma, FINEST * largest + np.finfo(np.float64).tiny)
        drives = self._sensing.noise[self._model.layout.n_x :]
        silent = np.isnan(drives)
        drives[silent] = noise_std(torque[-SAMPLES:, silent])
        drives = np.maximum(drives, FINEST * np.abs(torque).max(axis=0) + np.finfo(np.float64).tiny)
        periods = np.fmax(self._synchroniser.periods, 1.0 / self._rate)
        return sigma, drives**2 * periods

    def estimate(self) -> Estimate:
        """The base parameters as known now, with the prior; only after the first span."""
        return self.known.estimate(self.prior)
