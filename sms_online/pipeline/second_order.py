"""Second-order noise of rows, which nothing propagates: estimated from rows of noisy copies of the samples."""

from __future__ import annotations

import numpy as np

from sms_online.pipeline.sensor_noise import FINEST
from sms_online.state import State
from sms_online.stream import Array


def beyond_first_order(rows: Array, beta: Array) -> Array:
    """A sample of it (…, n_v), from rows [Y b] (…, COPIES, n_v, n + 1), for parameters β (n,).

    What is the same in the rows of noise and of its negative.
    """
    residual = rows[..., -1] - rows[..., :-1] @ beta
    return np.asarray(0.5 * (residual[..., 1, :] + residual[..., 2, :]) - residual[..., 0, :])


def size(rows: Array, beta: Array) -> Array:
    """Sum of the terms (…, n_v) of rows [Y b] (…, n_v, n + 1), each as if it were positive."""
    return np.asarray(np.abs(rows[..., :-1]) @ np.abs(beta) + np.abs(rows[..., -1]))


def rounding(largest: Array) -> Array:
    """Variance of rows whose terms add up to so much: where a coordinate has no noise they are exact to rounding."""
    return np.asarray((FINEST * largest) ** 2 + np.finfo(np.float64).tiny)


class SecondOrderNoise(State):
    """Variance of rows by what noise does beyond first order, by half width M of the motion's filter.

    means, M to (n_v,): mean squares of its samples.
    """

    means: dict[int, Array]

    def variance(self, half_width: int) -> Array:
        """(n_v,) for one half width; a width without samples counts as the nearest one that has some.

        A narrow filter lets through no less than the wide ones do, however few windows it has been used for.
        """
        least = min(self.means, key=lambda M: abs(M - half_width))
        return np.asarray(np.max([mean for M, mean in self.means.items() if least <= M], axis=0))
