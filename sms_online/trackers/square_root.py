"""Recursive least squares in square-root information form, by QR of blocks of rows."""

from __future__ import annotations

import numpy as np

from sms_online.state import State
from sms_online.stream import Array
from sms_online.trackers.factor import solve, triangular_factor
from sms_online.trackers.forgetting import Forgetting, NoForgetting
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Estimate, Prior, Rows, Tracker, checked, joined, prior_factor
from sms_online.trackers.memory import BLOCK_ROWS, Content, memory_for
from sms_online.trackers.robust import cluster_covariance

# No row is taken for better than this part of the rows' size: below it columns hold rounding, which is no information.
FINEST_ROWS = 1e-9


class PendingRows(State):
    """rows (M, n + 1): whitened, that wait for their block to be whole."""

    rows: Array


class RecursiveLeastSquares(Tracker):
    """Recursive solution of Y π = b, weighted by the rows' std; without forgetting it equals the batch solution (45).

    Rows are gathered into blocks of fixed size before they are absorbed, so that no bit of the result depends on how
    they were split into calls; an estimate counts the pending rows too and leaves them pending.
    A prior is not measured by the rows and does not age: it is added at each estimate and never forgotten.
    scaled_by_residual: the rows' std are right up to a common factor; it is taken from what the rows leave among
    themselves, so that they can be weighted against a prior and covariances need no scaling afterwards.
    Source: Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapter IV (SRIF data processing).
    """

    def __init__(
        self,
        n: int,
        forgetting: Forgetting | None = None,
        prior: Prior | None = None,
        scaled_by_residual: bool = False,
    ) -> None:
        self._scaled = scaled_by_residual
        self._n = n
        self._forgetting = forgetting if forgetting is not None else NoForgetting()
        self._prior = prior_factor(prior, n)
        self.begin(Information.none(n))

    def update(self, rows: Rows) -> None:
        """Take in rows; ValueError where their width is not n."""
        pending = np.concatenate((self._pending.rows, rows.whitened(self._n)))
        while len(pending) >= BLOCK_ROWS:
            self._memory.absorb(pending[:BLOCK_ROWS])
            pending = pending[BLOCK_ROWS:]
        self._pending.rows = pending.copy()

    def estimate(self) -> Estimate:
        """The estimate from all rows so far and the prior; leaves the state as it is."""
        content = self._memory.with_pending(self._pending.rows)
        scale = _residual_std(content) if self._scaled else 1.0
        solution = solve(triangular_factor(self._prior, content.factor / scale))
        robust = None
        if content.clusters is not None:
            robust = cluster_covariance(solution, content.clusters, self._prior, content.rows, scale)
        return Estimate(
            pi=solution.pi,
            covariance=solution.covariance(),
            covariance_robust=robust,
            determined=solution.determined,
            condition_number=solution.condition_number,
            rows=content.rows,
            rss=solution.rss,
            dof=max(content.rows + len(self._prior) - solution.rank, 0.0),
            scale=scale if self._scaled else None,
        )

    @property
    def information(self) -> Information:
        """Information of rows and prior."""
        content = self._memory.with_pending(self._pending.rows)
        return Information(triangular_factor(self._prior, content.factor), int(content.rows))

    def begin(self, known: Information) -> None:
        """Forget all rows, and go on from given information about π, which counts as older rows; the prior stays."""
        self._pending = PendingRows(np.empty((0, self._n + 1)))
        self._memory = memory_for(self._forgetting, self._n)
        self._memory.begin(checked(known, self._n))


def session_tracker(n: int, prior: Prior | None, nuisances: int = 0, within: bool = False) -> RecursiveLeastSquares:
    """The tracker of a balance's rows, of nuisances and then n parameters.

    Beside a prior on the parameters, the rows' std are right up to a common factor. within: it is part of what the
    tracker goes on from, see `begin`, and not to be added.
    """
    scaled = prior is not None
    if within:
        prior = None
    if prior is not None and nuisances:
        nothing = np.full(nuisances, np.nan)
        prior = joined(Prior(nothing, nothing), prior)
    return RecursiveLeastSquares(nuisances + n, prior=prior, scaled_by_residual=scaled)


def _residual_std(content: Content) -> float:
    """Standard deviation of the whitened rows about their own solution; 1 where there are too few of them."""
    alone = solve(content.factor)
    freedom = content.rows - alone.rank
    size = float(np.linalg.norm(content.factor[:, -1]))
    if freedom <= 0 or size == 0.0:
        return 1.0
    return max(float(np.sqrt(alone.rss / freedom)), FINEST_ROWS * size / float(np.sqrt(content.rows)))
