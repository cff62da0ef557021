"""Columns that are evaluated at samples of a smoothed motion, each sample once for all windows that hold it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.pipeline.smoothing import stride
from sms_online.state import State
from sms_online.stream import Array, Indices

# So many samples at once are smoothed and have their columns evaluated: of a long segment they would fill the memory.
PIECE = 400

# Numbers of samples (K,) and half width of the filter that they pass.
Samples = Sequence[tuple[Indices, int]]
# Evaluates columns at some samples: (K, entries).
Evaluation = Callable[[Samples], Array]


class SmoothedColumns(State):
    """Columns at every `step` th sample, of one half width of the filter, as far as windows have asked for them.

    first: number of the sample in the segment. columns (K, entries).
    """

    step: int
    first: int
    columns: Array


@dataclass(frozen=True)
class WindowSampling:
    """Where windows of `width` samples, `hop` apart, which wait for `margin` more, have their columns evaluated."""

    width: int
    hop: int
    margin: int

    def kept(
        self, kept: dict[int, SmoothedColumns], half_width: int, step: int, first: int, entries: int
    ) -> SmoothedColumns:
        """Columns of this half width that windows from sample `first` on need too."""
        smoothed = kept.get(half_width)
        if smoothed is None or smoothed.first + len(smoothed.columns) * step < first:
            smoothed = kept[half_width] = SmoothedColumns(step, first, np.empty((0, entries)))
        skip = max(0, (first - smoothed.first) // step)
        smoothed.columns = smoothed.columns[skip:]
        smoothed.first += skip * step
        return smoothed

    def seen(
        self, kept: SmoothedColumns, half_width: int, windows: Sequence[int], evaluate: Evaluation
    ) -> Iterator[Array]:
        """For each window, by its first sample, columns at all its samples of a step (width / step + 1, entries)."""
        step, known = kept.step, kept.first + len(kept.columns) * kept.step
        s = stride(half_width, self.hop)
        # Samples that the filter ends too late for, by their distance from the window's end: s of them share a width.
        tail = np.arange((half_width - self.margin - 1) // s, -1, -1) * s
        within = np.arange(s - step, -1, -step)
        ends = np.array(windows) + self.width
        fresh = np.arange(known, ends[-1] + step - tail.size * s, step)
        late = [((ends - d - within[:, None]).ravel(), self.margin + d) for d in tail.tolist()]
        *before, last = np.split(fresh, np.arange(PIECE, fresh.size, PIECE))
        pieces = [*([(piece, half_width)] for piece in before), [(last, half_width), *late]]
        columns = np.concatenate([evaluate(piece) for piece in pieces])
        kept.columns = np.concatenate((kept.columns, columns[: fresh.size]))
        tails = columns[fresh.size :].reshape(tail.size * within.size, len(windows), columns.shape[1])
        count = self.width // step + 1 - len(tails)
        for k, window in enumerate(windows):
            begin = (window - kept.first) // step
            yield np.concatenate((kept.columns[begin : begin + count], tails[:, k]))
