"""The batch least-squares solution (45), yardstick of the recursive ones."""

from __future__ import annotations

import numpy as np

from sms_online.stream import Array
from sms_online.trackers.factor import masked_covariance, solve
from sms_online.trackers.interface import Estimate, Rows


def batch_least_squares(Y: Array, b: Array, std: Array | None = None) -> Estimate:
    """π̂ = (YᵀY)⁻¹ Yᵀb (45), by SVD of the column-scaled Y itself.

    Y: (M, n). b: (M,). std: (M,) of the rows; without it all rows count the same, the covariance takes its level from
    the residual (infinite where no row is left over) and rss is in units of b².
    Raises ValueError where values are not finite or shapes do not fit.
    """
    M, n = Y.shape
    whitened = Rows(Y, b, np.ones(M) if std is None else std, np.zeros(M)).whitened(n)
    solution = solve(np.concatenate((whitened, np.zeros((max(n - M, 0), n + 1)))))
    dof = max(M - solution.rank, 0)
    if std is not None:
        covariance = solution.covariance()
    elif dof:
        covariance = solution.covariance(solution.rss / dof * np.eye(solution.rank))
    else:
        covariance = masked_covariance(np.zeros((n, n)), np.zeros(n, dtype=bool))
    return Estimate(
        pi=solution.pi,
        covariance=covariance,
        covariance_robust=None,
        determined=solution.determined,
        condition_number=solution.condition_number,
        rows=M,
        rss=solution.rss,
        dof=dof,
    )
