"""Unwhitened rows over their own standard deviations: by how much an estimate's residuals exceed noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from sms_online.pipeline.gram_sum import ROUNDED, GramSum
from sms_online.pipeline.momentum_windows import OVERLAP
from sms_online.state import State
from sms_online.stream import Array

# Mean square of a coordinate's residual over its predicted variance beyond which the model lacks something there: the
# noise behind the prediction scatters by 7 %, and colour that nobody knows of may double it.
LARGEST_RATIO = 2.0
# Few windows exceed it by chance: that one of all speeds does has at most this probability.
CHANCE = 1e-3


class PlainRows(State):
    """Sums over windows, by generalized speed.

    grams, noise: Gram matrices of rows [N Y b], and of a sample of the noise of [Y b], over their deviations with the
    weights of then. at_weights (n_v,): what such a sample leaves with those weights. windows: how many. misfit (n_v,):
    excess over one of the mean square of such rows' residual, zero where it may be chance. patient: excess may be a
    drift that is yet to be learned, and is none so far.
    """

    grams: GramSum
    noise: GramSum
    at_weights: Array
    misfit: Array
    windows: int = 0
    patient: bool = False

    @staticmethod
    def none(n_v: int, n: int, nuisances: int = 0, multiplying: Sequence[int] = ()) -> PlainRows:
        """Sums of no windows, with rows of n_v speeds, n parameters and m nuisances; multiplying: noise, of these."""
        signal = GramSum.none(n_v, nuisances + n + 1, multiplying)
        return PlainRows(signal, GramSum.none(n_v, n + 1), *np.zeros((2, n_v)))

    @property
    def gram(self) -> Array:
        """Gram matrices (n_v, m + n + 1, m + n + 1) of the rows."""
        return self.grams.matrices

    def clear(self) -> None:
        """Forget the windows, not the misfit."""
        self.grams, self.noise = (
            GramSum.none(len(each.total), each.total.shape[1], each.columns) for each in (self.grams, self.noise)
        )
        self.at_weights, self.windows = np.zeros_like(self.at_weights), 0

    def add(self, rows: Array, noise: Array, variance: Array, weights: Array, multiplied: Array | None = None) -> None:
        """Rows [N Y b] (n_v, m + n + 1) of a window, and what noise does to [Y b] of it.

        noise (n_v, n + 1): a sample; variance (n_v,): of the rows with weights (n,). multiplied (n_v, ·): a sample of
        what nuisances multiply, see `multiplied_noise`.
        """
        std = np.sqrt(variance)[:, None]
        sample = noise / std
        self.grams.add((rows / std)[:, None], None if multiplied is None else multiplied / std)
        self.noise.add(sample[:, None])
        self.at_weights = self.at_weights + (sample @ np.append(weights, -1.0)) ** 2
        self.windows += 1

    def _squares(self, beta: Array) -> Array:
        """Sum (n_v,) of the squares of every speed's residual for β (n,), over its predicted variance."""
        w, gram = np.append(beta, -1.0), self.gram
        squares = gram @ w @ w
        # Where samples are exact nothing but rounding is left of the sum.
        rounding = np.finfo(np.float64).eps * (np.abs(gram) @ np.abs(w) @ np.abs(w))
        # The variances are those of the weights; noise grows with β.
        own = w[-self.noise.total.shape[1] :]
        noise = self.noise.matrices @ own @ own
        scale = np.divide(
            noise, self.at_weights, out=np.ones_like(noise), where=(noise > 0.0) & (self.at_weights > 0.0)
        )
        return np.asarray((squares - ROUNDED * rounding) / scale)

    def whitened(self, rows: list[int], beta: Array) -> float | None:
        """rms of the residual of some generalized speeds' rows over its predicted standard deviation, for β (n,)."""
        if self.windows == 0:
            return None
        return float(np.sqrt(max(0.0, self._squares(beta)[rows].mean() / self.windows)))

    def excess(self, beta: Array) -> Array:
        """By how much the mean square of β's (n,) residual is above one (n_v,), zero where it may be chance."""
        if not self.windows:
            return self.misfit
        ratio = self._squares(beta) / self.windows
        independent = max(1.0, self.windows / OVERLAP)
        largest = max(LARGEST_RATIO, float(chdtri(independent, CHANCE / ratio.size)) / independent)
        return np.where(ratio > largest, ratio - 1.0, 0.0)

    def judge(self, beta: Array) -> None:
        """Take the misfit of β (n,) from the windows so far: none while that may be a drift."""
        self.misfit = np.zeros_like(self.misfit) if self.patient else self.excess(beta)
