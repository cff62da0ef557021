"""A tracker that keeps its rows for inspection."""

from __future__ import annotations

from sms_online.trackers.interface import Rows
from sms_online.trackers.square_root import RecursiveLeastSquares


class KeepingTracker(RecursiveLeastSquares):
    """Recursive least squares that keeps the rows too."""

    def __init__(self, n: int) -> None:
        super().__init__(n)
        self.kept: list[Rows] = []

    def update(self, rows: Rows) -> None:
        """Take in rows, and keep them."""
        self.kept.append(rows)
        super().update(rows)
