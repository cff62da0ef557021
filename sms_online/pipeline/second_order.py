"""Second-order noise of rows, which nothing propagates: estimated from rows of noisy copies of the samples.

Where an axis of dry friction rests or turns back, noise makes the sign of the friction. What that does to a row is
within the variance of stiction there, and is no noise of the rows in which the axis moves. Where rows hold more than
noise, it is counted in all of them: friction that turns back is what a law describes worst.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.pipeline.smoothing import HALF_WIDTHS
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices, Mask

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

    @staticmethod
    def of(samples: Array, taken: Mask, half_widths: Indices) -> SecondOrderNoise:
        """Of samples (W, n_v) of windows, those that are taken (W, n_v); half_widths (W,): of the windows' filters."""
        means = {}
        for M in np.unique(half_widths).tolist():
            own, count = taken[half_widths == M], np.sum(taken[half_widths == M], axis=0)
            means[M] = np.sum(own * samples[half_widths == M] ** 2, axis=0) / np.maximum(count, 1)
        return SecondOrderNoise(means)

    def variance(self, half_width: int) -> Array:
        """(n_v,) for one half width; a width without samples counts as the nearest one that has some.

        A narrow filter lets through no less than the wide ones do, however few windows it has been used for.
        """
        least = min(self.means, key=lambda M: abs(M - half_width))
        return np.asarray(np.max([mean for M, mean in self.means.items() if least <= M], axis=0))


class SampledNoise(State):
    """Second-order noise of windows so far; sampled, M to (n_v,): how many there are behind each mean, at most."""

    noise: SecondOrderNoise
    sampled: dict[int, Array]

    @staticmethod
    def none(n_v: int) -> SampledNoise:
        """Of no windows."""
        return SampledNoise(SecondOrderNoise(dict.fromkeys(HALF_WIDTHS, np.zeros(n_v))), {})

    def begin(self) -> None:
        """The same windows come once more: until a width comes again its mean counts."""
        self.sampled = {}

    def add(self, half_width: int, sample: Array, taken: Mask) -> None:
        """Take a window's samples (n_v,), those that are `taken` (n_v,)."""
        means, count = self.noise.means, self.sampled.get(half_width, np.zeros(sample.size))
        count = self.sampled[half_width] = np.minimum(count + taken, MOST_SAMPLES)
        change = taken * (sample**2 - means[half_width]) / np.maximum(count, 1.0)
        means[half_width] = means[half_width] + change


class RowErrorsState(State):
    """What is known of errors of rows so far.

    moving: of rows in which no axis of dry friction rests or turns back; whole: of all. largest (n_v,): largest sum of
    a row's terms.
    """

    moving: SampledNoise
    whole: SampledNoise
    largest: Array


class RowErrors(Stage):
    """Variance of the rows of a session's windows by what noise does beyond first order, and by numerics."""

    def __init__(self, n_v: int) -> None:
        self.state = RowErrorsState(SampledNoise.none(n_v), SampledNoise.none(n_v), np.zeros(n_v))

    def begin(self) -> None:
        """The same windows come once more, with other weights."""
        self.state.moving.begin()
        self.state.whole.begin()
        # A fit that failed may have made terms larger than those of any row are.
        self.state.largest = np.zeros_like(self.state.largest)

    def push(self, half_widths: Sequence[int], samples: Array, resting: Mask, sizes: Array) -> tuple[Array, Array]:
        """Twice (W, n_v) of the next windows, by their filter's half widths: of moving axes, and of all rows alike.

        samples (W, n_v): of what is beyond first order. resting (W, n_v): see `RoughForces.resting`. sizes (W, n_v):
        sums of the rows' terms.
        """
        now, out, every = self.state, np.empty((2, *samples.shape)), np.ones(samples.shape[1], dtype=np.bool_)
        for k, M in enumerate(half_widths):
            now.largest = np.maximum(now.largest, sizes[k])
            for means, taken, own in ((now.moving, ~resting[k], out[0]), (now.whole, every, out[1])):
                means.add(M, samples[k], taken)
                own[k] = means.noise.variance(M) + numerical(now.largest)
        return out[0], out[1]
