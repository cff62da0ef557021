"""Rows of a session over their own standard deviations: what they leave of an estimate beyond what noise does."""

from __future__ import annotations

import numpy as np

from sms_online.state import State
from sms_online.stream import Array

# Mean square of a coordinate's residual over its predicted variance beyond which the model lacks something there: a
# second of windows scatters by 20 %, the noise behind the prediction by 7 %.
LARGEST_RATIO = 2.0
# Rounding of a sum of products, in units of its last place.
ROUNDED = 16.0


class PlainRows(State):
    """Sums over windows, by generalized speed.

    gram (n_v, n + 1, n + 1): Gram matrices of rows [Y b] over their deviations. windows: how many. misfit (n_v,):
    excess over one of the mean square of such rows' residual, zero where it may be chance. patient: excess
    may be a drift that is yet to be learned, and is none so far.
    """

    gram: Array
    misfit: Array
    windows: int = 0
    patient: bool = False

    @staticmethod
    def none(n_v: int, n: int) -> PlainRows:
        """Of no windows, with rows of n_v speeds and n parameters."""
        return PlainRows(np.zeros((n_v, n + 1, n + 1)), np.zeros(n_v))

    def clear(self) -> None:
        """Forget the windows, not the misfit."""
        self.gram, self.windows = np.zeros_like(self.gram), 0

    def add(self, rows: Array, variance: Array) -> None:
        """Rows [Y b] (n_v, n + 1) of a window, and what noise makes of each (n_v,)."""
        plain = rows / np.sqrt(variance)[:, None]
        gram = plain[:, :, None] * plain[:, None, :]
        gram += self.gram
        self.gram = gram
        self.windows += 1

    def _squares(self, beta: Array) -> Array:
        """Sum (n_v,) of the squares of every speed's residual for β (n,), over its predicted variance."""
        w = np.append(beta, -1.0)
        squares = np.einsum("i,vij,j->v", w, self.gram, w)
        # Where samples are exact nothing but rounding is left of the sum.
        rounding = np.finfo(np.float64).eps * np.einsum("i,vij,j->v", np.abs(w), np.abs(self.gram), np.abs(w))
        return np.asarray(squares - ROUNDED * rounding)

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
        return np.where((ratio > LARGEST_RATIO) & (not self.patient), ratio - 1.0, 0.0)

    def judge(self, beta: Array) -> None:
        """Take the misfit of β (n,) from the windows so far."""
        self.misfit = self.excess(beta)
