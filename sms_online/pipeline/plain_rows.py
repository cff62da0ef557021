"""Rows of a session over their own standard deviations: what they leave of an estimate beyond what noise does."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from sms_online.pipeline.momentum_windows import OVERLAP
from sms_online.state import State
from sms_online.stream import Array

# Mean square of a coordinate's residual over its predicted variance beyond which the model lacks something there: the
# noise behind the prediction scatters by 7 %, and colour that nobody knows of may double it.
LARGEST_RATIO = 2.0
# Few windows exceed it by chance: that one of all speeds does has at most this probability.
CHANCE = 1e-3
# Rounding of a sum of products, in units of its last place.
ROUNDED = 16.0


class PlainRows(State):
    """Sums over windows, by generalized speed.

    gram, noise (n_v, n + 1, n + 1): Gram matrices of rows [Y b] and of a sample of their noise, over their deviations
    with the weights of then. at_weights (n_v,): what such a sample leaves with those weights. windows: how many.
    misfit (n_v,): excess over one of the mean square of such rows' residual, zero where it may be chance. patient:
    excess may be a drift that is yet to be learned, and is none so far.
    """

    gram: Array
    noise: Array
    at_weights: Array
    misfit: Array
    windows: int = 0
    patient: bool = False

    @staticmethod
    def none(n_v: int, n: int) -> PlainRows:
        """Of no windows, with rows of n_v speeds and n parameters."""
        return PlainRows(*np.zeros((2, n_v, n + 1, n + 1)), *np.zeros((2, n_v)))

    def clear(self) -> None:
        """Forget the windows, not the misfit."""
        self.gram, self.noise = np.zeros_like(self.gram), np.zeros_like(self.noise)
        self.at_weights, self.windows = np.zeros_like(self.at_weights), 0

    def add(self, rows: Array, noise: Array, variance: Array, weights: Array) -> None:
        """Rows [Y b] (n_v, n + 1) of a window, a sample of their noise, and its variance (n_v,) with weights (n,)."""
        std = np.sqrt(variance)[:, None]
        plain, sample = rows / std, noise / std
        self.gram = self.gram + plain[:, :, None] * plain[:, None, :]
        self.noise = self.noise + sample[:, :, None] * sample[:, None, :]
        self.at_weights = self.at_weights + (sample @ np.append(weights, -1.0)) ** 2
        self.windows += 1

    def _squares(self, beta: Array) -> Array:
        """Sum (n_v,) of the squares of every speed's residual for β (n,), over its predicted variance."""
        w = np.append(beta, -1.0)
        squares = np.einsum("i,vij,j->v", w, self.gram, w)
        # Where samples are exact nothing but rounding is left of the sum.
        rounding = np.finfo(np.float64).eps * np.einsum("i,vij,j->v", np.abs(w), np.abs(self.gram), np.abs(w))
        # The variances are those of the weights; noise grows with β.
        noise = np.einsum("i,vij,j->v", w, self.noise, w)
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
        return np.where((ratio > largest) & (not self.patient), ratio - 1.0, 0.0)

    def judge(self, beta: Array) -> None:
        """Take the misfit of β (n,) from the windows so far."""
        self.misfit = self.excess(beta)
