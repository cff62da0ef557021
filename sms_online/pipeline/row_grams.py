"""Gram matrices of whitened rows and of what sensors' noise adds to them, as they grow from block of time to block."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec
import numpy as np

from sms_online.pipeline.gram_sum import GramSum, PackedGrams
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.state import State
from sms_online.stream import Array

# A block of time is two windows long at least, for neighbours to share little. When there are so many, they merge: with
# eight to sixteen, their scatter is known to a quarter, and they are as long as a session allows. Even.
SHORTEST_BLOCK, MOST_BLOCKS = 2 * HOPS, 16


class Mark(State):
    """Sums as they were at the end of a block of time."""

    signal: PackedGrams
    noise: PackedGrams

    @property
    def matrices(self) -> tuple[Array, Array]:
        """Both (n_v, m + n + 1, m + n + 1) and (n_v, n + 1, n + 1)."""
        return self.signal.matrices, self.noise.matrices

    def scaled(self, share: Array) -> Mark:
        """The same, counting so much (n_v,) of what they count now."""
        return Mark(self.signal.scaled(share), self.noise.scaled(share))


class RowGrams(State):
    """Sums over windows of whitened rows, by generalized speed.

    signal (n_v, m + n + 1, m + n + 1): Gram matrices of [N Y b], N the columns of m nuisances. noise (n_v, n + 1,
    n + 1): of what the sensors' noise adds to [Y b], of first and of second order, from synthetic noise; N it leaves as
    it is. windows: how many. marks: both as they were after each block of time, of `length` windows each.
    """

    signal: GramSum
    noise: GramSum
    windows: int = 0
    marks: list[Mark] = msgspec.field(default_factory=list)
    length: int = SHORTEST_BLOCK

    @staticmethod
    def none(n_v: int, n: int, nuisances: int = 0, multiplying: Sequence[int] = ()) -> RowGrams:
        """Gram matrices of no windows, with rows of n_v speeds, n parameters and m nuisances.

        multiplying: those that multiply noise.
        """
        return RowGrams(GramSum.none(n_v, nuisances + n + 1, multiplying), GramSum.none(n_v, n + 1))

    def add(self, rows: Array, noisy: Array, shared: Array | None = None) -> None:
        """Rows [N Y b] (n_v, m + n + 1) of a window; noisy (2, n_v, m + n + 1): with synthetic noise, and less it.

        shared (n_v, ·): a sample of what nuisances multiply, see `multiplied_noise`.
        """
        of_noise = slice(self.nuisances, None)
        plus, minus, between = noisy[0, :, of_noise], noisy[1, :, of_noise], rows[:, of_noise]
        self.signal.add(rows[:, None], shared)
        self.noise.add(np.stack((0.5 * (plus - minus), 0.5 * (plus + minus) - between), axis=1))
        self.windows += 1
        if self.windows % self.length == 0:
            self.marks.append(Mark(PackedGrams.of(self.signal.matrices), PackedGrams.of(self.noise.matrices)))
            if len(self.marks) == MOST_BLOCKS:
                self.marks, self.length = self.marks[1::2], 2 * self.length

    @property
    def nuisances(self) -> int:
        """m."""
        return int(self.signal.total.shape[1] - self.noise.total.shape[1])

    def without_blocks(self) -> Iterator[RowGrams]:
        """The sums without each block of time in turn; windows behind the last whole block are part of it."""
        whole = self.signal.matrices, self.noise.matrices
        before, begin = (np.zeros_like(whole[0]), np.zeros_like(whole[1])), 0
        for k, mark in enumerate(self.marks, start=1):
            last = k == len(self.marks)
            after, end = (whole, self.windows) if last else (mark.matrices, k * self.length)
            signal, noise = (each - (up - down) for each, up, down in zip(whole, after, before, strict=True))
            yield RowGrams(GramSum(signal), GramSum(noise), self.windows - (end - begin))
            before, begin = after, end

    def block_products(self, w: Array) -> tuple[Array, Array]:
        """Products (blocks, n_v, m + n + 1) and (blocks, n_v, n + 1) of both, over each block of time, with w."""
        own, ends = w[self.nuisances :], self.marks[:-1]
        signal = [mark.signal.times(w) for mark in ends], self.signal.matrices @ w
        noise = [mark.noise.times(own) for mark in ends], self.noise.matrices @ own
        return _apart(*signal), _apart(*noise)

    def block_diagonals(self) -> tuple[Array, Array]:
        """The diagonals of both, over each block of time, of the same shapes."""
        ends = self.marks[:-1]
        signal = [mark.signal.diagonals for mark in ends], np.einsum("vii->vi", self.signal.matrices)
        noise = [mark.noise.diagonals for mark in ends], np.einsum("vii->vi", self.noise.matrices)
        return _apart(*signal), _apart(*noise)

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
        self.marks = [mark.scaled(share) for mark in self.marks]

    @staticmethod
    def _of_noise(noise: Array, weights: Array) -> Array:
        """Sum of squares (n_v,) of the rows' noise with parameters β (n,)."""
        w = np.append(weights, -1.0)
        return np.asarray(noise @ w @ w)


def _apart(ends: list[Array], whole: Array) -> Array:
    """What each block of time adds to a sum: to those at the ends of all but the last, and to that of all windows."""
    return np.diff(np.array([np.zeros_like(whole), *ends, whole]), axis=0)
