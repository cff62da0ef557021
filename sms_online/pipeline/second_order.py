"""Second-order noise of rows, which nothing propagates: estimated from rows of noisy copies of the samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.pipeline.smoothing import HALF_WIDTHS
from sms_online.state import Stage, State
from sms_online.stream import Array

# Windows of one filter's width over which the square of such a sample is averaged. The samples of windows that overlap
# are nearly one, so a mean over few of them follows its own luck: rows in which it is low would be trusted too much.
MOST_SAMPLES = 100
# What rows of samples without noise are off by, over the sum of their terms: sums over samples are no integrals, and
# motions come from integrators. Of this program's simulator it is 2e-9, of MuJoCo's 9e-9; one part in 2^24, to which
# single precision rounds, is 6e-8.
NUMERICAL = 1e-8


def beyond_first_order(rows: Array, beta: Array) -> Array:
    """A sample of it (…, n_v), from rows [Y b] (…, COPIES, n_v, n + 1), for parameters β (n,).

    What is the same in the rows of noise and of its negative.
    """
    residual = rows[..., -1] - rows[..., :-1] @ beta
    return np.asarray(0.5 * (residual[..., 1, :] + residual[..., 2, :]) - residual[..., 0, :])


def size(rows: Array, beta: Array) -> Array:
    """Sum of the terms (…, n_v) of rows [Y b] (…, n_v, n + 1), each as if it were positive."""
    return np.asarray(np.abs(rows[..., :-1]) @ np.abs(beta) + np.abs(rows[..., -1]))


def numerical(largest: Array) -> Array:
    """Variance of rows whose terms add up to so much, where nothing that acts on them has noise."""
    return np.asarray((NUMERICAL * largest) ** 2 + np.finfo(np.float64).tiny)


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


class RowErrorsState(State):
    """What is known of errors of rows so far.

    sampled: windows behind the mean squares, by the filter's half width. largest (n_v,): largest sum of a row's terms.
    """

    second_order: SecondOrderNoise
    sampled: dict[int, int]
    largest: Array


class RowErrors(Stage):
    """Variance of the rows of a session's windows by what noise does beyond first order, and by numerics."""

    def __init__(self, n_v: int) -> None:
        none = np.zeros(n_v)
        means = SecondOrderNoise(dict.fromkeys(HALF_WIDTHS, none))
        self.state = RowErrorsState(means, dict.fromkeys(HALF_WIDTHS, 0), none)

    def begin(self) -> None:
        """The same windows come once more, with other weights: until a width comes again its mean counts."""
        self.state.sampled = dict.fromkeys(HALF_WIDTHS, 0)
        # A fit that failed may have made terms larger than those of any row are.
        self.state.largest = np.zeros_like(self.state.largest)

    def push(self, half_widths: Sequence[int], samples: Array, sizes: Array) -> Array:
        """(W, n_v) of the next windows, by their filter's half widths.

        samples (W, n_v): of what is beyond first order. sizes (W, n_v): sums of the rows' terms.
        """
        now, out = self.state, np.empty_like(samples)
        means = now.second_order.means
        for own, M, sample, terms in zip(out, half_widths, samples, sizes, strict=True):
            now.sampled[M] = min(now.sampled[M] + 1, MOST_SAMPLES)
            means[M] = means[M] + (sample**2 - means[M]) / now.sampled[M]
            now.largest = np.maximum(now.largest, terms)
            own[:] = now.second_order.variance(M) + numerical(now.largest)
        return out
