"""What is known of calibration and parameters beside the rows, where the rows may contradict it.

Tolerances of calibration have the heavier tails of Student's t: what the rows clearly contradict is released at
the cost of a logarithm, and does not bias all others. Within two deviations the distribution is nearly normal. Priors
of parameters hold.

Columns of calibration are evaluated with some π and scale with it, as the rows do. What multiplies them is therefore
measured in units that scale with π too. In fixed units a nuisance beyond its tolerance would draw π to zero, where the
same correction takes a smaller multiple.

Source: O'Hagan and Pericchi, Bayesian heavy-tailed models and conflict resolution, Brazilian J. Probability and
Statistics 26 (2012) 372.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sms_online.stream import Array

# Degrees of freedom of Student's t and one more.
TAIL = 5.0
# The unit of a nuisance is no smaller than this share of what it is at the weights.
LEAST_UNIT = 0.05
# Between zero and a nuisance far beyond its tolerance lies a ridge: a second search begins with tolerances so much
# wider, and narrows them.
WIDENED = (1e3, 30.0, 1.0)
# Solutions at each width, for weights that follow the solution; and directions of scaled columns that none is given of.
PASSES, RANK_TOLERANCE = 6, 1e-12


@dataclass(frozen=True)
class PriorInformation:
    """Rows [N Y b] of m nuisances and n parameters, each of unit variance, that do not come from samples.

    certain (k, m + n + 1): what rows before an event said, and priors. doubtful (j, m + n + 1): tolerances of nuisances
    whose columns scale with π, one a row.
    """

    certain: Array
    doubtful: Array

    @staticmethod
    def none(n: int) -> PriorInformation:
        """Nothing is known of n parameters."""
        return PriorInformation(np.zeros((0, n + 1)), np.zeros((0, n + 1)))

    def beside(self, rows: Array) -> PriorInformation:
        """The same with more that is certain, rows (k, m + n + 1)."""
        return replace(self, certain=np.concatenate((self.certain, rows)))


class Penalty:
    """What a w = (ν, π, -1) costs that is off from what is known beforehand, and its derivatives.

    nuisances: m. squares (n_v, m + n + 1): sums of squares of the rows' columns, by generalized speed. weights
    (m + n + 1,): w with the π behind the columns of calibration. widened: factor to all tolerances and priors.
    """

    def __init__(
        self, known: PriorInformation, nuisances: int, squares: Array, weights: Array, widened: float = 1.0
    ) -> None:
        self._certain = known.certain
        self._rows = known.doubtful / widened
        self._units = np.zeros_like(known.doubtful)
        m = nuisances
        if not len(known.doubtful):
            return
        own = np.argmax(np.abs(known.doubtful[:, :m]), axis=1)
        # A speed's rows scale with what projects π on the weights, in the metric of their columns.
        metric = squares[:, m:-1] * weights[m:-1]
        size = np.sqrt(metric @ weights[m:-1])
        scale = np.divide(metric, size[:, None] ** 2, out=np.zeros_like(metric), where=size[:, None] > 0.0)
        share = squares[:, own] * (size > 0.0)[:, None]
        total = share.sum(axis=0)
        share = np.divide(share, total, out=np.zeros_like(share), where=total > 0.0)
        self._units[:, m:-1] = share.T @ scale
        self._units[:, -1] = np.where(total > 0.0, 0.0, -1.0)

    def _deviations(self, w: Array) -> tuple[Array, Array, Array]:
        """z (j,), its derivatives (j, m + n + 1), and its weight (j,) under Student's t."""
        units = self._units @ w
        floored = units < LEAST_UNIT
        units = np.where(floored, LEAST_UNIT, units)
        z = (self._rows @ w) / units
        slopes = (self._rows - np.where(floored, 0.0, z)[:, None] * self._units) / units[:, None]
        return z, slopes, 1.0 / (1.0 + z**2 / TAIL)

    def value(self, w: Array) -> float:
        """The penalty, in units of the logarithm of a likelihood."""
        z, _, _ = self._deviations(w)
        return 0.5 * float(np.sum((self._certain @ w) ** 2)) + 0.5 * TAIL * float(np.sum(np.log1p(z**2 / TAIL)))

    def derivatives(self, w: Array) -> tuple[Array, Array]:
        """Slope (m + n,) by ν and π, and curvature (m + n, m + n), that of least squares with the weights at w."""
        z, slopes, weight = self._deviations(w)
        rows = np.concatenate((self._certain, np.sqrt(weight)[:, None] * slopes))[:, :-1]
        residual = np.concatenate((self._certain @ w, np.sqrt(weight) * z))
        return rows.T @ residual, rows.T @ rows


def fitted(gram: Array, known: PriorInformation, nuisances: int, start: Array) -> Array:
    """Least squares (m + n,) of rows with a Gram matrix (m + n + 1, m + n + 1) of [N Y b], their variance as stated.

    start (m + n,): holds the π behind the columns of calibration.
    """
    w = np.append(start, -1.0)
    squares = np.diag(gram)[None]
    for widened in WIDENED:
        penalty = Penalty(known, nuisances, squares, np.append(start, -1.0), widened)
        for _ in range(PASSES):
            slope, curvature = penalty.derivatives(w)
            information = gram[:-1, :-1] + curvature
            size = np.sqrt(np.diag(information))
            size = np.where(size > 0.0, size, 1.0)
            downhill = -((gram @ w)[:-1] + slope) / size
            step = np.linalg.lstsq(information / np.outer(size, size), downhill, rcond=RANK_TOLERANCE)[0] / size
            w[:-1] += step
    return w[:-1]
