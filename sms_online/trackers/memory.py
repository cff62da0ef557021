"""What a square-root tracker remembers of the blocks of rows it has absorbed, one class per way of forgetting."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import msgspec
import numpy as np

from sms_online.state import Stage, State
from sms_online.stream import Array
from sms_online.trackers.factor import extended, triangular_factor
from sms_online.trackers.forgetting import FadingForgetting, Forgetting, NoForgetting, SlidingWindow
from sms_online.trackers.information import Information
from sms_online.trackers.robust import MAX_CLUSTERS, ClusterFactors, merge_neighbours

# Rows of one internal block: the QR of 32 x 17 costs about as much as that of 17 x 17, so below it the overhead of the
# call dominates; above it an estimate has more pending rows to factor again.
BLOCK_ROWS = 32


@dataclass(frozen=True)
class Content:
    """What a memory holds: factor (n + 1, n + 1), rows it counts for, clusters (C, k, n + 1) where they exist."""

    factor: Array
    rows: float
    clusters: Array | None


class Memory(Protocol):
    """Store of absorbed blocks, a `State` or a `Stage`; a block is (M, n + 1) whitened rows."""

    def begin(self, known: Information) -> None:
        """Count the information of earlier rows, before the first block."""

    def absorb(self, block: Array) -> None:
        """Take in a full block of BLOCK_ROWS rows."""

    def with_pending(self, block: Array) -> Content:
        """What the memory would hold after a last, unfinished block (M ≥ 0 rows); the memory stays as it is."""


class FullMemory(State):
    """All rows, as one factor and the factors of their clusters."""

    factor: Array
    clusters: ClusterFactors
    rows: int = 0

    @staticmethod
    def none(n: int) -> FullMemory:
        """Content of no rows of n parameters."""
        return FullMemory(np.zeros((n + 1, n + 1)), ClusterFactors.none(n))

    def begin(self, known: Information) -> None:
        """See Memory; the rows behind it are in no cluster."""
        self.factor, self.rows = known.factor, known.rows

    def absorb(self, block: Array) -> None:
        """See Memory."""
        self.factor = extended(self.factor, block)
        self.rows += len(block)
        self.clusters.add(block)

    def with_pending(self, block: Array) -> Content:
        """See Memory."""
        return Content(extended(self.factor, block), self.rows + len(block), self.clusters.stack(block))


class FadingState(State):
    """What is left of rows that fade.

    factor (n + 1, n + 1), of so many rows. peak (n,): greatest square-root information that each parameter had.
    """

    factor: Array
    peak: Array
    rows: float = 0.0


class FadingMemory(Stage):
    """One factor in which older rows fade."""

    def __init__(self, n: int, forgetting: FadingForgetting) -> None:
        self._forgetting = forgetting
        self.state = FadingState(np.zeros((n + 1, n + 1)), np.zeros(n))

    def begin(self, known: Information) -> None:
        """See Memory."""
        self.state.factor, self.state.rows = known.factor, float(known.rows)
        self.state.peak = np.linalg.norm(known.factor[:, :-1], axis=0)

    def absorb(self, block: Array) -> None:
        """See Memory."""
        self.state.factor, self.state.rows, self.state.peak = self._advanced(block)

    def with_pending(self, block: Array) -> Content:
        """See Memory."""
        factor, rows, _ = self._advanced(block)
        return Content(factor, rows, None)

    def _advanced(self, block: Array) -> tuple[Array, float, Array]:
        """Factor, effective rows and peak after a block."""
        if not len(block):
            return self.state.factor, self.state.rows, self.state.peak
        n = self.state.peak.size
        weight = self._forgetting.factor ** len(block)
        row_weights = self._forgetting.row_weights(len(block))
        new = triangular_factor(block * row_weights[:, None])
        attained = np.hypot(np.linalg.norm(self.state.factor[:n, :n], axis=0), np.linalg.norm(new[:, :n], axis=0))
        peak = np.maximum(self.state.peak, attained)
        faded = self._forgetting.fade(self.state.factor, np.where(peak > 0, peak, 1.0), new, weight)
        return triangular_factor(faded, new), weight * self.state.rows + float(row_weights @ row_weights), peak


class WindowMemory(State):
    """The factors of the last blocks (n + 1, n + 1), as many as the window has, and the rows of each."""

    n: int
    most: int
    blocks: list[Array] = msgspec.field(default_factory=list)
    counts: list[int] = msgspec.field(default_factory=list)

    def begin(self, known: Information) -> None:
        """See Memory; it counts as one block, the first to leave."""
        if known.factor.any():
            self._append(known.factor, known.rows)

    def _append(self, factor: Array, rows: int) -> None:
        self.blocks = [*self.blocks, factor][-self.most :]
        self.counts = [*self.counts, rows][-self.most :]

    def absorb(self, block: Array) -> None:
        """See Memory."""
        self._append(triangular_factor(block), len(block))

    def with_pending(self, block: Array) -> Content:
        """See Memory."""
        factors = np.stack((*self.blocks, triangular_factor(block)))
        clusters = merge_neighbours(factors, -(-len(factors) // MAX_CLUSTERS))
        return Content(
            triangular_factor(clusters.reshape(-1, self.n + 1)),
            sum(self.counts) + len(block),
            clusters,
        )


def memory_for(forgetting: Forgetting, n: int) -> Memory:
    """The empty memory of a kind of forgetting for n parameters."""
    if isinstance(forgetting, NoForgetting):
        return FullMemory.none(n)
    if isinstance(forgetting, SlidingWindow):
        return WindowMemory(n, -(-forgetting.rows // BLOCK_ROWS))
    return FadingMemory(n, forgetting)
