"""The unit that flows from a source into the pipeline: a block of consecutive samples in SI units."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Number = TypeVar("Number", np.float64, np.int64)


@dataclass(frozen=True)
class Block:
    """B consecutive samples of C channels.

    t: (B,) seconds, not decreasing. values: (B, C) SI units, NaN where a channel was not sampled at that instant.
    channels: C names, see the README's list of channels.
    """

    t: Array
    channels: tuple[str, ...]
    values: Array

    def __post_init__(self) -> None:
        if self.values.shape != (self.t.size, len(self.channels)):
            raise ValueError(
                f"values {self.values.shape} do not fit {self.t.size} samples x {len(self.channels)} channels"
            )

    def pieces(self, rows: int) -> Iterator[Block]:
        """The same samples in blocks of at most so many."""
        for k in range(0, self.t.size, rows):
            yield Block(self.t[k : k + rows], self.channels, self.values[k : k + rows])


class Source(Protocol):
    """Anything that yields blocks in order of time: a capture file, a CAN log, a live bus."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels of every block."""

    @property
    def warnings(self) -> Sequence[str]:
        """What was skipped or repaired so far, counted, one sentence each."""

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks, in order of time."""


class Relayed:
    """A source's channels and warnings, passed on; whoever inherits this says which blocks."""

    def __init__(self, source: Source) -> None:
        self.source = source

    @property
    def channels(self) -> tuple[str, ...]:
        """See `Source`."""
        return self.source.channels

    @property
    def warnings(self) -> Sequence[str]:
        """See `Source`; of all that was read."""
        return self.source.warnings


def increments(values: NDArray[Number], before: float | NDArray[Number]) -> NDArray[Number]:
    """values (M, …) less the ones before them along the first axis; `before` comes before the first.

    As numpy.diff with prepend, at a fifth of its cost for a few values.
    """
    out = values.copy()
    if len(out):
        out[1:] -= values[:-1]
        out[:1] -= before  # type: ignore[arg-type]  # of the same kind as the values
    return out
