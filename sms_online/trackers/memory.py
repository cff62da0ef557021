"""What a square-root tracker remembers of the blocks of rows it has absorbed, one class per way of forgetting."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sms_online.stream import Array
from sms_online.trackers.factor import triangular_factor
from sms_online.trackers.forgetting import FadingForgetting, Forgetting, NoForgetting, SlidingWindow
from sms_online.trackers.information import Information
from sms_online.trackers.interface import State, saved_array, saved_number
from sms_online.trackers.robust import MAX_CLUSTERS, ClusterFactors, merge_neighbours

# Rows of one internal block: the QR of 32 x 17 costs about as much as that of 17 x 17, so below it the overhead of the
# call dominates; above it an estimate has more pending rows to factor again.
BLOCK_ROWS = 32


@dataclass(frozen=True)
class Content:
    """What a memory holds: factor (n + 1, n + 1), rows it counts for, clusters (C, n + 1, n + 1) where they exist."""

    factor: Array
    rows: float
    clusters: Array | None


class Memory(Protocol):
    """Store of absorbed blocks; a block is (M, n + 1) whitened rows."""

    def begin(self, known: Information) -> None:
        """Count what earlier rows say, before the first block."""

    def absorb(self, block: Array) -> None:
        """Take in a full block of BLOCK_ROWS rows."""

    def with_pending(self, block: Array) -> Content:
        """What the memory would hold after a last, unfinished block (M ≥ 0 rows); the memory stays as it is."""

    def state(self) -> State:
        """What continues it bit for bit."""

    def restore(self, state: Mapping[str, Array | float]) -> None:
        """Continue from a saved state."""


class FullMemory:
    """All rows, as one factor and the factors of their clusters."""

    def __init__(self, n: int) -> None:
        self._factor = np.zeros((n + 1, n + 1))
        self._rows = 0
        self._clusters = ClusterFactors(n)

    def begin(self, known: Information) -> None:
        """See Memory; the rows behind it are in no cluster."""
        self._factor, self._rows = known.factor, known.rows

    def absorb(self, block: Array) -> None:
        """See Memory."""
        factor = triangular_factor(block)
        self._factor = triangular_factor(self._factor, factor)
        self._rows += len(block)
        self._clusters.add(factor)

    def with_pending(self, block: Array) -> Content:
        """See Memory."""
        pending = triangular_factor(block)
        return Content(triangular_factor(self._factor, pending), self._rows + len(block), self._clusters.stack(pending))

    def state(self) -> State:
        """See Memory."""
        # The factor is replaced, never written.
        return {"factor": self._factor, "rows": float(self._rows), **self._clusters.state()}

    def restore(self, state: Mapping[str, Array | float]) -> None:
        """See Memory."""
        self._clusters.restore(state)
        self._factor = saved_array(state, "factor", self._factor.shape)
        self._rows = int(saved_number(state, "rows"))


class FadingMemory:
    """One factor in which older rows fade."""

    def __init__(self, n: int, forgetting: FadingForgetting) -> None:
        self._forgetting = forgetting
        self._factor = np.zeros((n + 1, n + 1))
        self._peak = np.zeros(n)  # greatest square-root information that each parameter ever had
        self._rows = 0.0

    def begin(self, known: Information) -> None:
        """See Memory."""
        self._factor, self._rows = known.factor, float(known.rows)
        self._peak = np.linalg.norm(known.factor[:, :-1], axis=0)

    def absorb(self, block: Array) -> None:
        """See Memory."""
        self._factor, self._rows, self._peak = self._advanced(block)

    def with_pending(self, block: Array) -> Content:
        """See Memory."""
        factor, rows, _ = self._advanced(block)
        return Content(factor, rows, None)

    def _advanced(self, block: Array) -> tuple[Array, float, Array]:
        """Factor, effective rows and peak after a block."""
        if not len(block):
            return self._factor, self._rows, self._peak
        n = self._peak.size
        weight = self._forgetting.factor ** len(block)
        row_weights = self._forgetting.row_weights(len(block))
        new = triangular_factor(block * row_weights[:, None])
        attained = np.hypot(np.linalg.norm(self._factor[:n, :n], axis=0), np.linalg.norm(new[:, :n], axis=0))
        peak = np.maximum(self._peak, attained)
        faded = self._forgetting.fade(self._factor, np.where(peak > 0, peak, 1.0), new, weight)
        return triangular_factor(faded, new), weight * self._rows + float(row_weights @ row_weights), peak

    def state(self) -> State:
        """See Memory."""
        return {"faded_factor": self._factor.copy(), "faded_rows": self._rows, "peak": self._peak.copy()}

    def restore(self, state: Mapping[str, Array | float]) -> None:
        """See Memory."""
        self._peak = saved_array(state, "peak", self._peak.shape)
        self._factor = saved_array(state, "faded_factor", self._factor.shape)
        self._rows = saved_number(state, "faded_rows")


class WindowMemory:
    """The factors of the last blocks."""

    def __init__(self, n: int, rows: int) -> None:
        self._n = n
        self._blocks: deque[Array] = deque(maxlen=-(-rows // BLOCK_ROWS))
        self._counts: deque[int] = deque(maxlen=self._blocks.maxlen)

    def begin(self, known: Information) -> None:
        """See Memory; it counts as one block, the first to leave."""
        self._append(known.factor, known.rows)

    def _append(self, factor: Array, rows: int) -> None:
        self._blocks.append(factor)
        self._counts.append(rows)

    def absorb(self, block: Array) -> None:
        """See Memory."""
        self._append(triangular_factor(block), len(block))

    def with_pending(self, block: Array) -> Content:
        """See Memory."""
        factors = np.stack((*self._blocks, triangular_factor(block)))
        clusters = merge_neighbours(factors, -(-len(factors) // MAX_CLUSTERS))
        return Content(
            triangular_factor(clusters.reshape(-1, self._n + 1)),
            sum(self._counts) + len(block),
            clusters,
        )

    def state(self) -> State:
        """See Memory."""
        n1 = self._n + 1
        window = np.stack(self._blocks) if self._blocks else np.zeros((0, n1, n1))
        return {"window": window, "window_rows": np.array(self._counts, dtype=np.float64)}

    def restore(self, state: Mapping[str, Array | float]) -> None:
        """See Memory."""
        window = saved_array(state, "window", (None, self._n + 1, self._n + 1))
        counts = saved_array(state, "window_rows", (len(window),))
        self._blocks = deque(window, maxlen=self._blocks.maxlen)
        self._counts = deque((int(count) for count in counts), maxlen=self._blocks.maxlen)


def memory_for(forgetting: Forgetting, n: int) -> Memory:
    """The empty memory of a kind of forgetting for n parameters."""
    if isinstance(forgetting, NoForgetting):
        return FullMemory(n)
    if isinstance(forgetting, SlidingWindow):
        return WindowMemory(n, forgetting.rows)
    return FadingMemory(n, forgetting)
