"""Blocked cross-validation: blocks of time are held out in turn, and the rest of the session predicts them.

Rows of neighbouring windows share samples, so windows are held out a block of time at once, and those that overlap it
are not fitted either. What an effect improves is the fall of the rms of held-out rows; its standard error comes from
leaving out one block after the other (jackknife), for windows of a block are no independent witnesses. Of several
captures each is predicted from the others, which is what its next run will be.
Sources: Burman, Chow, Nolan, Biometrika 81 (1994) 351 (blocks); Efron, Stein, Annals of Statistics 9 (1981) 586
(variance of the jackknife).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_online.pipeline.momentum_windows import HOPS
from sms_online.stream import Array, Indices, Mask

# Blocks that a session is cut into; fewer where each would hold fewer windows than overlap.
BLOCKS = 10
# What held-out rows rise by for one more coefficient that they do not need is below this share.
LEAST_RISE = 0.02
# Block number of windows that are fitted always.
ALWAYS = -1


class Folds:
    """Blocks of the windows (W,) of a session.

    block (W,): number of the block that holds a window out, ALWAYS where none does. segment, time (W,): of the windows,
    in the order of time within a segment. capture (W,): number of the capture, of several; blocks are predicted from
    the other captures then. parts: how many sets of windows are predicted from the others, captures or blocks.
    """

    def __init__(
        self,
        block: Indices,
        segment: Indices,
        time: Array,
        capture: Indices | None = None,
    ) -> None:
        self.block, self._segment, self._time = block, segment, time
        self.count = int(block.max(initial=ALWAYS)) + 1
        self.across = capture is not None and np.unique(capture[block != ALWAYS]).size > 1
        self._part = block
        if capture is not None and self.across:
            self._part = np.where(block == ALWAYS, ALWAYS, np.unique(capture, return_inverse=True)[1])
        self.parts = int(self._part.max(initial=ALWAYS)) + 1

    @classmethod
    def of(
        cls,
        segment: Indices,
        time: Array,
        tested: Mask | None = None,
        capture: Indices | None = None,
    ) -> Folds:
        """Blocks of as many windows each; tested (W,): those that are held out at all, all of them by default."""
        held = np.arange(time.size) if tested is None else np.flatnonzero(tested)
        count = max(2, min(BLOCKS, held.size // HOPS))
        block = np.full(time.size, ALWAYS, dtype=np.int64)
        block[held] = np.arange(held.size) * count // max(1, held.size)
        return cls(block, segment, time, capture)

    def held(self, k: int) -> Mask:
        """Windows (W,) of a block."""
        return np.asarray(self.block == k)

    def predicted(self, part: int) -> Mask:
        """Windows (W,) of a part."""
        return np.asarray(self._part == part)

    def fitted(self, part: int) -> Mask:
        """Windows (W,) that a part is predicted from: those that share no sample with it.

        All but the part where few of those that are tested are left: in a session of a second all windows overlap.
        """
        held = self.predicted(part)
        near = held.copy()
        for hop in range(1, HOPS):
            same = self._segment[hop:] == self._segment[:-hop]
            near[hop:] |= held[:-hop] & same
            near[:-hop] |= held[hop:] & same
        tested = self.block != ALWAYS
        return ~near if 2 * np.count_nonzero(tested & ~near) > np.count_nonzero(tested) else ~held

    def of_others(self, segment: Indices, time: Array) -> Indices:
        """Numbers (V,) of the parts of other windows of the same session: that of the nearest of these windows."""
        out = np.full(time.size, ALWAYS, dtype=np.int64)
        for number in np.unique(segment):
            own, others = np.flatnonzero(self._segment == number), segment == number
            if own.size:
                edges = 0.5 * (self._time[own][1:] + self._time[own][:-1])
                out[others] = self._part[own][np.searchsorted(edges, time[others])]
        return out


@dataclass(frozen=True)
class Fall:
    """Share by which an rms falls, and its standard error over the blocks."""

    share: float
    std: float

    @property
    def certain(self) -> bool:
        """Whether it exceeds the scatter of the blocks."""
        return self.share > 2.0 * self.std

    @property
    def rises(self) -> bool:
        """Whether the rms rises by more than a further coefficient explains, and than the scatter of the blocks."""
        return self.share < -max(LEAST_RISE, 2.0 * self.std)


def fall(before: Array, after: Array) -> Fall:
    """Fall of the rms, from sums of squares by block (B,)."""
    used = before + after > 0.0
    before, after = before[used], after[used]
    if before.size == 0 or not before.sum() > 0.0:
        return Fall(0.0, 0.0)

    def share(b: Array, a: Array) -> Array:
        return 1.0 - np.sqrt(a / np.maximum(b, np.finfo(np.float64).tiny))

    n = before.size
    if n == 1:
        return Fall(float(share(before.sum(), after.sum())), np.inf)
    left_out = share(before.sum() - before, after.sum() - after)
    std = np.sqrt((n - 1) / n * np.sum((left_out - left_out.mean()) ** 2))
    return Fall(float(share(before.sum(), after.sum())), float(std))
