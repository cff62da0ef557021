"""What the spans of a session have determined so far, as one record."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sms_online.row_types import NOISE_WHITENED
from sms_online.smoother.jackknife import SpanBlock, jackknife_covariance, with_span
from sms_online.smoother.search import LARGEST_MEAN_SQUARE, SpanFit
from sms_online.stream import Array
from sms_online.trackers.factor import solve, triangular_factor
from sms_online.trackers.interface import Estimate, Prior, prior_factor

# Unexplained forces beside torques, times their noise, beyond which parameters are off by more than error bars say.
LARGEST_TORQUE_NOISE = 3.0


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

    @staticmethod
    def none(tolerances: Array, n: int) -> SmootherStatistics:
        """Nothing is known of nuisances with tolerances (m,), and of n parameters."""
        size = tolerances.size + n
        nothing = np.zeros((size + 1, size + 1)), np.full(size, np.nan)
        return SmootherStatistics((), 0, np.nan, np.nan, *nothing, 0, 0.0, np.nan, -np.inf, 0, tolerances)

    def with_span(self, fit: SpanFit, end: float, lost: int, prior: Prior | None) -> SmootherStatistics:
        """The same with a span more, that ends at `end`, s. lost: samples by then. prior: see `estimate`."""
        known = self._replace(
            spans=self.spans + 1,
            level=float(np.fmax(self.level, fit.level)),
            mean_square=float(np.fmax(self.mean_square, fit.mean_square)),
            factor=triangular_factor(self.factor, fit.factor),
            beta=fit.beta,
            rows=self.rows + fit.rows,
            rss=self.rss + fit.rows * fit.mean_square,
            last_step=self.last_step if np.isfinite(self.last_step) else fit.step,
            end=end,
            lost=lost,
            torque_noise=max(self.torque_noise, fit.torque_noise),
            blocks=with_span(self.blocks, fit.rows, fit.factor),
        )
        # Here, as it takes a solution for each block, and estimates are asked for more often than spans end.
        scatter = None if known.exact else jackknife_covariance(known.blocks, known.beforehand(prior))
        return known._replace(scatter=scatter)

    @property
    def exact(self) -> bool:
        """Whether samples agree with the equations of motion, and nothing had to be allowed for."""
        return self.beyond == 1.0 and self.torque_noise == 1.0 and self.level == 0.0

    @property
    def contradicted(self) -> bool:
        """Whether samples contradict the equations of motion: parameters are off by more than error bars say."""
        return self.level > 0.0 or self.torque_noise > LARGEST_TORQUE_NOISE or self.beyond > NOISE_WHITENED

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
