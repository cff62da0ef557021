"""Gram matrices of whitened rows and of what sensors' noise adds to them, as they grow from block of time to block."""

from __future__ import annotations

import msgspec
import numpy as np

from sms_online.pipeline.gram_sum import GramSum
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.state import State
from sms_online.stream import Array

# A block of time is two windows long at least, for neighbours to share little. When there are so many, they merge: with
# eight to sixteen, their scatter is known to a quarter, and they are as long as a session allows. Even.
SHORTEST_BLOCK, MOST_BLOCKS = 2 * HOPS, 16


class RowGrams(State):
    """Sums over windows of whitened rows, by generalized speed.

    signal (n_v, n + 1, n + 1): Gram matrices of [Y b]. noise: the same of what the sensors' noise adds to the rows, of
    first and of second order, from synthetic noise. windows: how many. marks (2, n_v, n + 1, n + 1): both as they were
    after each block of time, of `length` windows each.
    """

    signal: GramSum
    noise: GramSum
    windows: int = 0
    marks: list[Array] = msgspec.field(default_factory=list)
    length: int = SHORTEST_BLOCK

    @staticmethod
    def none(n_v: int, n: int) -> RowGrams:
        """Gram matrices of no windows, with rows of n_v speeds and n parameters."""
        return RowGrams(GramSum.none(n_v, n + 1), GramSum.none(n_v, n + 1))

    def add(self, rows: Array, noisy: Array) -> None:
        """Rows [Y b] (n_v, n + 1) of a window; noisy (2, n_v, n + 1): with synthetic noise added and subtracted."""
        first, second = 0.5 * (noisy[0] - noisy[1]), 0.5 * (noisy[0] + noisy[1]) - rows
        self.signal.add(rows[:, None])
        self.noise.add(np.stack((first, second), axis=1))
        self.windows += 1
        if self.windows % self.length == 0:
            self.marks.append(self._both)
            if len(self.marks) == MOST_BLOCKS:
                self.marks, self.length = self.marks[1::2], 2 * self.length

    @property
    def _both(self) -> Array:
        return np.stack((self.signal.matrices, self.noise.matrices))

    @property
    def block_ends(self) -> Array:
        """Both sums (blocks + 1, 2, n_v, n + 1, n + 1) as they were before the first block of time and after each.

        Windows behind the last whole block are part of it.
        """
        whole = self._both
        return np.stack([np.zeros_like(whole), *self.marks[:-1], whole])

    def without_blocks(self) -> list[RowGrams]:
        """The sums without each block of time in turn."""
        if not self.marks:
            return []
        whole = self._both
        windows = np.diff([*(self.length * k for k in range(len(self.marks))), self.windows]).tolist()
        out = []
        for block, count in zip(np.diff(self.block_ends, axis=0), windows, strict=True):
            signal, noise = whole - block
            out.append(RowGrams(GramSum(signal), GramSum(noise), self.windows - count))
        return out

    def whiten_anew(self, before: tuple[Array, Array], now: tuple[Array, Array]) -> None:
        """Have the rows so far count as those to come, whose variance others predict: their weights and misfit.

        Either (n,), of the parameters behind the variance, and (n_v,). Rows that leave more than noise are weighted by
        what they were thought to leave then: it may differ a hundredfold from one time to the next. Rows to come that
        leave no more are whitened against each other, as those before were not: these count no more than they did.
        """
        noise = self.noise.matrices
        then, later = ((1.0 + misfit) * self._of_noise(noise, weights) for weights, misfit in (before, now))
        share = np.divide(then, later, out=np.ones_like(then), where=(then > 0.0) & (later > 0.0))
        lacking = now[1] > 0.0
        share = np.where(lacking, share, np.minimum(1.0, (1.0 + before[1]) / (1.0 + now[1])))
        self.signal.scale(share)
        self.noise.scale(share)
        self.marks = [share[:, None, None] * mark for mark in self.marks]

    @staticmethod
    def _of_noise(noise: Array, weights: Array) -> Array:
        """Sum of squares (n_v,) of the rows' noise with parameters β (n,); nuisances before them make none."""
        w = np.append(weights, -1.0)
        return np.asarray(noise[:, -w.size :, -w.size :] @ w @ w)
