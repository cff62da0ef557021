"""Information of rows about π in square-root form, and its update when parameters jump or join."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sms_online.stream import Array
from sms_online.trackers.factor import RANK_TOLERANCE, Solution, extended, solve, triangular_factor


@dataclass(frozen=True)
class Information:
    """The information of so many whitened rows.

    factor (n + 1, n + 1): upper triangular, see `factor`. It is never written, so whoever keeps one has it as it was.
    """

    factor: Array
    rows: int

    @staticmethod
    def none(n: int) -> Information:
        """The information of no rows about n parameters."""
        return Information(np.zeros((n + 1, n + 1)), 0)

    @property
    def n(self) -> int:
        """Number of parameters."""
        return len(self.factor) - 1

    def with_rows(self, rows: Array) -> Information:
        """The same with further whitened rows [Y b] (M, n + 1)."""
        return Information(extended(self.factor, rows), self.rows + len(rows))

    def solution(self) -> Solution:
        """The least-squares solution."""
        return solve(self.factor)

    def shifted(self, by: Array) -> Information:
        """The same about parameters that are larger by so much (n,)."""
        factor = self.factor.copy()
        factor[:, -1] += factor[:, :-1] @ by
        return Information(factor, self.rows)

    def without(self, columns: Iterable[int]) -> Information:
        """What is left when nothing is known of some parameters any more."""
        columns, factor = list(columns), self.factor
        others = [k for k in range(len(factor)) if k not in columns]
        norm = np.linalg.norm(factor[:, columns], axis=0)
        U, s, _ = np.linalg.svd(factor[:, columns] / np.where(norm > 0.0, norm, 1.0))
        # What those parameters do not reach is what the others know without them.
        rank = int(np.count_nonzero(s > RANK_TOLERANCE))
        out = np.zeros_like(factor)
        out[: len(factor) - rank, others] = U[:, rank:].T @ factor[:, others]
        return Information(triangular_factor(out), self.rows)

    def widened(self, more: int) -> Information:
        """With `more` parameters appended, of which nothing is known."""
        n = self.n
        out = np.zeros((n + more + 1, n + more + 1))
        out[: n + 1, :n], out[: n + 1, -1] = self.factor[:, :n], self.factor[:, -1]
        return Information(triangular_factor(out), self.rows)
