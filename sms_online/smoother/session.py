"""The smoother of a session: samples gathered into spans, each span fitted with what the spans before it told."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.physical import PhysicalSet
from sms_online.pipeline.noise import noise_std
from sms_online.pipeline.sensing import Sensing, stated_noise
from sms_online.pipeline.sensor_noise import FEWEST_SAMPLES, SAMPLES
from sms_online.pipeline.synchronise import GridSamples, Synchroniser
from sms_online.sensor_set import Readings, readable_channels
from sms_online.smoother.fit import DivergedError, SpanFit, SpanSmoother
from sms_online.smoother.span import Span
from sms_online.stream import Array, Block
from sms_online.trackers.factor import solve, triangular_factor
from sms_online.trackers.interface import Estimate, Prior, prior_factor

# Length of a span, s. Its first state is unknown, which costs some information; its arrays take some 10 MB a second.
SPAN = 10.0
# A shorter one may not hold a motion.
LEAST_SPAN = 0.5
# No channel is better than this share of its largest reading: the collocation errs by as much.
FINEST = 1e-6


class SmootherStatistics(NamedTuple):
    """What the spans so far have determined; nothing in it changes as the session goes on.

    failures: spans that were left out and why, a sentence each. spans, rows: how many were taken. mean_square: of the
    last span, see `SpanFit`; level: the largest of all. factor (n + 1, n + 1): square-root information about beta (n,).
    last_step: of the last fit. end: time of the newest sample, s.
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

    def estimate(self, prior: Prior | None) -> Estimate:
        """The base parameters, with what is known of them beforehand; only after the first span."""
        n = self.beta.size
        problem = triangular_factor(prior_factor(prior, n), self.factor)
        problem[:, n] -= problem[:, :n] @ self.beta
        solution = solve(problem)
        return Estimate(
            pi=self.beta.copy(),
            covariance=solution.covariance(),
            covariance_robust=None,
            determined=solution.determined,
            condition_number=solution.condition_number,
            rows=float(self.rows),
            rss=self.rss,
            dof=max(float(self.rows - solution.rank), 0.0),
        )


class Smoother:
    """Estimates the base parameters of a session from all its samples and the equations of motion.

    It works span by span: a span's rows of independent unit errors join those of the spans before it. channels: of the
    readings that it uses, see `sensor_set.Readings`. failures: spans that were left out and why, a sentence each.
    spans: how many it took. mean_square: of the last one, see `SpanFit`; level: the largest of all. prior: what it was
    told beforehand, or None.
    """

    def __init__(self, model: Model, base: BaseParameters, sensing: Sensing, available: Sequence[str]) -> None:
        self._model, self._base, self._sensing = model, base, sensing
        self._rate, joints = model.system.sample_rate, len(model.system.joints)
        self.channels = tuple(name for name in readable_channels(model) if name in available)
        self.failures: list[str] = []
        self.spans = 0
        self.mean_square = self.level = np.nan
        self.prior: Prior | None = None
        self._synchroniser = Synchroniser([f"n_tau_{i}" for i in range(1, joints + 1)], self._rate)
        # Of the spans so far.
        self._factor = np.zeros((base.n + 1, base.n + 1))
        self._beta = np.full(base.n, np.nan)
        self._rows, self._rss, self._last_step, self._end = 0, 0.0, np.nan, -np.inf
        # Of the spans to come: samples, torques on the grid, and the motion that the pipeline took from the sensors.
        self._t, self._values = np.empty(0), np.empty((0, len(self.channels)))
        self._index, self._torque = np.empty((0, 2), dtype=np.int64), np.empty((0, joints))  # grid index, segment
        self._moved = np.empty(0, dtype=np.int64)
        self._motion = np.empty((0, model.layout.n_x + model.layout.n_v))

    def set_prior(self, prior: Prior) -> None:
        """Weigh the samples against what is known of the base parameters beforehand; before the first sample."""
        self.prior = prior

    @property
    def end(self) -> float:
        """Time of the newest sample behind the estimate, s; -inf where there is none."""
        return self._end

    def push(self, t: Array, torque: Array, values: Array) -> None:
        """Take samples at t (B,), s, in order of time: n τ (B, joints), readings (B, channels), else NaN."""
        self._t, self._values = np.concatenate((self._t, t)), np.concatenate((self._values, values))
        for piece in self._synchroniser.push(Block(t, self._synchroniser.channels, torque)):
            self._keep(piece)

    def _keep(self, piece: GridSamples) -> None:
        index = np.stack((piece.index, np.full(piece.index.size, piece.segment)), axis=1)
        self._index, self._torque = np.concatenate((self._index, index)), np.concatenate((self._torque, piece.values))

    def move(self, index: NDArray[np.int64], x: Array, v: Array) -> None:
        """Take the motion as the sensors alone tell it, at grid samples (B,): x (B, n_x), v (B, n_v)."""
        self._moved = np.concatenate((self._moved, index))
        self._motion = np.concatenate((self._motion, np.concatenate((x, v), axis=1)))

    def work(self, first_fit: Callable[[], Estimate], last: bool = False) -> None:
        """Fit the spans that are complete; `last` at the end of the session.

        first_fit: gives an estimate to begin with, until a span has told one.
        """
        if last:
            for piece in self._synchroniser.flush():
                self._keep(piece)
        while (count := self._complete(last)) > 0:
            end = int(self._index[count - 1, 0])
            if not last and not (self._moved.size and self._moved[-1] >= end):
                return
            if count > max(LEAST_SPAN * self._rate, FEWEST_SAMPLES):
                self._fit(count, first_fit)
            self._forget(count)

    def _complete(self, last: bool) -> int:
        """Torque samples of the first span, 0 where more of them may come."""
        segment = self._index[:, 1]
        run = int(np.searchsorted(segment, segment[0], side="right")) if segment.size else 0
        longest = round(SPAN * self._rate) + 1
        if run >= longest:
            return longest
        return run if last or run < segment.size else 0

    def _time(self, index: NDArray[np.int64]) -> Array:
        return np.asarray(self._synchroniser.start_time + index / self._rate)

    def _forget(self, count: int) -> None:
        """Drop a span; the sample that ends it begins the next one, if there is no gap between them."""
        goes_on = count < len(self._index) and self._index[count, 1] == self._index[count - 1, 1]
        dropped = count - 1 if goes_on else count
        end = self._index[count - 1, 0]
        self._index, self._torque = self._index[dropped:], self._torque[dropped:]
        kept = self._t > self._time(end)
        self._t, self._values = self._t[kept], self._values[kept]
        kept = self._moved >= end
        self._moved, self._motion = self._moved[kept], self._motion[kept]

    def _fit(self, count: int, first_fit: Callable[[], Estimate]) -> None:
        torque_t = self._time(self._index[:count, 0])
        begin, end = torque_t[0], torque_t[-1]
        inside = (self._t >= begin) & (self._t <= end)
        moved = (self._moved >= self._index[0, 0]) & (self._moved <= self._index[count - 1, 0])
        values, sigma, torque_density = self._weighed(self._t[inside], self._values[inside], self._torque[:count])
        sensed = np.flatnonzero(np.isfinite(sigma))
        readings = Readings(self._model, [self.channels[k] for k in sensed])
        guess_x, guess_v = np.split(self._motion[moved], [self._model.layout.n_x], axis=1)
        span = Span(
            torque_t, self._torque[:count], self._t[inside], values[:, sensed],
            self._time(self._moved[moved]), guess_x, guess_v,
        )  # fmt: skip
        smoother = SpanSmoother(self._model, self._base, readings, sigma[sensed], torque_density)
        try:
            if not moved.any():
                raise DivergedError("the sensors tell no motion to begin with")
            beta = self._beta if self.spans else self._realisable(first_fit())
            known = triangular_factor(prior_factor(self.prior, self._base.n), self._factor)
            fit = smoother.fit(span, beta, known, self._last_step if self.spans else None)
        except DivergedError as error:
            self.failures.append(f"{begin:.6g} … {end:.6g} s: {error}")
            return
        self._take(fit, end)

    def _take(self, fit: SpanFit, end: float) -> None:
        self._factor = triangular_factor(self._factor, fit.factor)
        self._beta, self._last_step, self._end = fit.beta, fit.step, end
        self._rows += fit.rows
        self._rss += fit.rows * fit.mean_square
        self.mean_square, self.level = fit.mean_square, float(np.fmax(self.level, fit.level))
        self.spans += 1

    def _realisable(self, estimate: Estimate) -> Array:
        """β (n,) of the real bodies nearest to an estimate."""
        variance = estimate.rss / estimate.dof if estimate.scale is None and estimate.dof > 0.0 else 1.0
        covariance = np.where(np.isfinite(estimate.covariance), estimate.covariance * max(variance, 1.0), np.inf)
        try:
            return PhysicalSet(self._model, self._base).project(estimate.pi, covariance).beta
        except ArithmeticError as error:
            raise DivergedError(str(error)) from None

    def _weighed(self, t: Array, values: Array, torque: Array) -> tuple[Array, Array, Array]:
        """Samples at t, their noise (C,), NaN where nothing is known of it, and the torques' density (joints,)."""
        sigma = stated_noise(self._model.system, self.channels)
        for k in np.flatnonzero(np.isnan(sigma)):
            own = np.flatnonzero(np.isfinite(values[:, k]))[-SAMPLES:]
            if own.size >= FEWEST_SAMPLES:
                sigma[k] = noise_std(values[own, k][:, None], t[own])[0]
        largest = np.max(np.abs(values), axis=0, initial=0.0, where=np.isfinite(values))
        sigma = np.maximum(sigma, FINEST * largest + np.finfo(np.float64).tiny)
        drives = self._sensing.noise[self._model.layout.n_x :]
        silent = np.isnan(drives)
        drives[silent] = noise_std(torque[-SAMPLES:, silent])
        drives = np.maximum(drives, FINEST * np.abs(torque).max(axis=0) + np.finfo(np.float64).tiny)
        periods = np.fmax(self._synchroniser.periods, 1.0 / self._rate)
        return values, sigma, drives**2 * periods

    def estimate(self) -> Estimate:
        """The base parameters as known now, with the prior; only after the first span."""
        return self.statistics().estimate(self.prior)

    def statistics(self) -> SmootherStatistics:
        """What is known now."""
        return SmootherStatistics(
            tuple(self.failures), self.spans, self.level, self.mean_square, self._factor, self._beta, self._rows,
            self._rss, self._last_step, self._end,
        )  # fmt: skip

    def state(self) -> dict[str, dict[str, Any]]:
        """Everything that `restore` needs to continue to the same bits."""
        return {
            "smoother": {
                **self.statistics()._asdict(), "failures": np.array(self.failures, dtype=np.str_),
                "t": self._t, "values": self._values, "index": self._index, "torque": self._torque,
                "moved": self._moved, "motion": self._motion,
            },
            "smoother_torques": dict(self._synchroniser.state()),
        }  # fmt: skip

    def restore(self, saved: Mapping[str, Mapping[str, NDArray[Any]]]) -> None:
        """Continue from a saved state."""
        state = saved["smoother"]
        self.failures, self.spans = [str(text) for text in state["failures"]], int(state["spans"])
        self.mean_square, self.level = float(state["mean_square"]), float(state["level"])
        self._factor, self._beta = np.array(state["factor"]), np.array(state["beta"])
        self._rows, self._rss = int(state["rows"]), float(state["rss"])
        self._last_step, self._end = float(state["last_step"]), float(state["end"])
        self._t, self._values = np.array(state["t"]), np.array(state["values"])
        self._index, self._torque = np.array(state["index"]), np.array(state["torque"])
        self._moved, self._motion = np.array(state["moved"]), np.array(state["motion"])
        self._synchroniser.restore(saved["smoother_torques"])
