"""Gram matrices of rows, by generalized speed, summed over a session's windows."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dspmv

from sms_online.state import State
from sms_online.stream import Array

# Windows that are added together: of one alone, reading and writing the sum costs more than the products.
GATHERED = 16
# Rounding of a sum of products, in units of its last place.
ROUNDED = 16.0


class GramSum(State):
    """Sum of Gram matrices, and the rows of the last windows, which are not in it yet.

    total (n_v, n, n). waiting: rows (n_v, k, n) of each window. less (n_v, c): squares that are to be taken off the
    products of columns with themselves and with the last one, see `multiplied_noise`.
    """

    total: Array
    waiting: list[Array] = msgspec.field(default_factory=list)
    columns: tuple[int, ...] = ()
    less: Array | None = None

    @staticmethod
    def none(n_v: int, n: int, columns: Sequence[int] = ()) -> GramSum:
        """Sums of no rows with n columns, of n_v speeds; columns: those that share noise with the last one."""
        return GramSum(np.zeros((n_v, n, n)), [], tuple(columns), np.zeros((n_v, len(columns))) if columns else None)

    @property
    def matrices(self) -> Array:
        """(n_v, n, n) of all rows so far."""
        if not self.waiting:
            return self.total
        # In one order in memory, whichever they came in: it decides on the last bits.
        rows = np.ascontiguousarray(np.concatenate(self.waiting, axis=1))
        out = np.asarray(self.total + rows.swapaxes(1, 2) @ rows)
        if self.less is not None:
            take_off(out, self.columns, self.less)
        return out

    def add(self, rows: Array, shared: Array | None = None) -> None:
        """Rows (n_v, k, n) of a window, k of each speed; shared (n_v, c): noise that columns have and the last one."""
        self.waiting.append(rows)
        if self.less is not None and shared is not None:
            self.less = self.less + shared**2
        if len(self.waiting) == GATHERED:
            self._gather(self.matrices)

    def _gather(self, matrices: Array) -> None:
        self.total, self.waiting = matrices, []
        self.less = None if self.less is None else np.zeros_like(self.less)

    def scale(self, share: Array) -> None:
        """Have the rows so far count so much, (n_v,) of their squares."""
        self._gather(share[:, None, None] * self.matrices)


def take_off(grams: Array, columns: Sequence[int], squares: Array) -> None:
    """Take squares (…, c) off the products of columns with themselves and with the last one, in grams (…, n, n)."""
    at = list(columns)
    grams[..., at, at] -= squares
    grams[..., at, -1] -= squares
    grams[..., -1, at] -= squares


class PackedGrams(State):
    """Symmetric matrices as they were at some time: their upper triangles alone, which take half the memory.

    triangles (n_v, n (n + 1) / 2): by columns, as BLAS packs them. share (n_v,): what they count now.
    """

    triangles: Array
    share: Array

    @staticmethod
    def of(matrices: Array) -> PackedGrams:
        """Of matrices (n_v, n, n)."""
        n_v, n, _ = matrices.shape
        return PackedGrams(matrices.reshape(n_v, n * n)[:, _triangle(n)], np.ones(n_v))

    def scaled(self, share: Array) -> PackedGrams:
        """The same, counting so much (n_v,) of what they count now."""
        return PackedGrams(self.triangles, self.share * share)

    @property
    def _n(self) -> int:
        return int(np.sqrt(2 * self.triangles.shape[1]))

    @property
    def matrices(self) -> Array:
        """(n_v, n, n)."""
        n, scaled = self._n, self.share[:, None] * self.triangles
        out = np.empty((len(scaled), n * n))
        out[:, _triangle(n)] = out[:, _triangle(n, upper=True)] = scaled
        return out.reshape(-1, n, n)

    @property
    def diagonals(self) -> Array:
        """(n_v, n)."""
        ends = np.cumsum(np.arange(1, self._n + 1)) - 1
        return np.asarray(self.share[:, None] * self.triangles[:, ends])

    def times(self, w: Array) -> Array:
        """Products (n_v, n) with w (n,)."""
        n = self._n
        products = [dspmv(n, 1.0, each, w) for each in self.triangles]
        return np.asarray(self.share[:, None] * np.array(products))


@lru_cache(maxsize=8)
def _triangle(n: int, upper: bool = False) -> NDArray[np.intp]:
    """Where the entries of the lower triangle, or their mirror images, lie in a matrix (n, n), row by row."""
    rows, columns = np.tril_indices(n)
    return columns * n + rows if upper else rows * n + columns
