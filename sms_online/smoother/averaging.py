"""Where a search ends whose steps are no longer than the parameters are uncertain, but do not shorten.

Undamped modes that no force of note excites follow the noise: within a standard deviation of a light inertia their
frequencies pass many peaks of its spectrum, and the sum of squares has as many minima. Gauss-Newton goes from one to
another. The mean of what its steps aim at is the estimate then, and their scatter is part of its covariance.
Source: Polyak and Juditsky, SIAM J. Control and Optimization 30 (1992) 838, for the mean of iterates.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.stream import Array
from sms_online.trackers.factor import triangular_factor

# So many steps in a row give a scatter, if none asks a parameter to move by more standard deviations than this; or than
# the other where innovations hold more than noise, for dry friction, whose law is never quite true, has corners.
FEWEST_TARGETS = 8
LONGEST_STEP, LONGEST_MISFIT = 3.0, 20.0


def averaged(factor: Array, targets: Sequence[Array]) -> tuple[Array, Array]:
    """Factor (n + 1, n + 1) and estimate (n,) of rows whose minima scatter about their mean as the targets (k, n) do.

    Factor: of the rows at one of the targets. Its rows have, beside their unit errors, those that the scatter makes.
    """
    beta = np.mean(targets, axis=0)
    rows = factor[:-1, :-1]
    # A minimum is drawn from the scatter; the mean of k of them is not better than one, as all see the same noise.
    errors = rows @ (np.asarray(targets) - beta).T / np.sqrt(len(targets) - 1)
    root = np.linalg.cholesky(np.eye(len(rows)) + errors @ errors.T)
    whitened = np.linalg.solve(root, rows)
    end = np.zeros((1, factor.shape[1]))
    end[0, -1] = factor[-1, -1]
    return triangular_factor(np.column_stack((whitened, whitened @ beta)), end), beta
