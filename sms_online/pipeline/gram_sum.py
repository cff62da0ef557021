"""Gram matrices of rows, by generalized speed, summed over a session's windows."""

from __future__ import annotations

import msgspec
import numpy as np

from sms_online.state import State
from sms_online.stream import Array

# Windows that are added together: of one alone, reading and writing the sum costs more than the products.
GATHERED = 16


class GramSum(State):
    """Sum of Gram matrices, and the rows of the last windows, which are not in it yet.

    total (n_v, n, n). waiting: rows (n_v, k, n) of each window.
    """

    total: Array
    waiting: list[Array] = msgspec.field(default_factory=list)

    @staticmethod
    def none(n_v: int, n: int) -> GramSum:
        """Sums of no rows with n columns, of n_v speeds."""
        return GramSum(np.zeros((n_v, n, n)))

    @property
    def matrices(self) -> Array:
        """(n_v, n, n) of all rows so far."""
        if not self.waiting:
            return self.total
        # In one order in memory, whichever they came in: it decides on the last bits.
        rows = np.ascontiguousarray(np.concatenate(self.waiting, axis=1))
        return np.asarray(self.total + rows.swapaxes(1, 2) @ rows)

    def add(self, rows: Array) -> None:
        """Rows (n_v, k, n) of a window, k of each speed."""
        self.waiting.append(rows)
        if len(self.waiting) == GATHERED:
            self.total, self.waiting = self.matrices, []

    def scale(self, share: Array) -> None:
        """Have the rows so far count so much, (n_v,) of their squares."""
        self.total, self.waiting = share[:, None, None] * self.matrices, []
