"""The samples of a session, kept for its diagnosis: a residual is traced over the whole of it, not in passing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.description.schema import System
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.pipeline.observer import Observer
from sms_online.pipeline.synchronise import GridSamples
from sms_online.stream import Array, Indices

# What is kept at most, s: twenty minutes of a planar arm at 1 kHz are 200 MB, and no effect needs more to be found.
LONGEST = 1200.0
# Windows that a session is judged by at most: of a longer one stretches are taken, in window lengths.
MOST_WINDOWS, STRETCH = 2500, 5.0


@dataclass(frozen=True)
class Segment:
    """Grid samples without a gap: index (N,) on the session's grid, values (N, channels), SI units."""

    index: Indices
    values: Array


class SampleRecord(Observer):
    """Collects the grid samples of a session, up to LONGEST seconds of them."""

    def __init__(self, sample_rate: float) -> None:
        self._pieces: list[GridSamples] = []
        self._left = round(LONGEST * sample_rate)

    def samples(self, piece: GridSamples) -> None:
        """See `Observer`."""
        kept = min(self._left, piece.index.size)
        if kept:
            self._pieces.append(GridSamples(piece.index[:kept], piece.values[:kept], piece.segment))
            self._left -= kept

    def segments(self) -> list[Segment]:
        """The session so far, cut where its gaps are."""
        return list(joined(self._pieces).values())


def joined(pieces: Sequence[GridSamples]) -> dict[int, Segment]:
    """Consecutive samples as their segments, by number."""
    out = {}
    for number in dict.fromkeys(piece.segment for piece in pieces):
        own = [piece for piece in pieces if piece.segment == number]
        index, values = (np.concatenate([getattr(piece, part) for piece in own]) for part in ("index", "values"))
        out[number] = Segment(index, values)
    return out


def bounded(system: System) -> tuple[int, int]:
    """Samples of a stretch, and most samples, of a session that is used in part: more windows add nothing new."""
    windows, rate = system.windows, system.sample_rate
    return round(STRETCH * windows.momentum * rate), round(MOST_WINDOWS * windows.momentum / HOPS * rate)


def excerpts(segments: Sequence[Segment], length: int, most: int) -> list[Segment]:
    """Stretches of `length` samples, evenly spread over segments that hold more than `most`; else the segments."""
    total = sum(segment.index.size for segment in segments)
    if total <= most:
        return list(segments)
    out = []
    for segment in segments:
        size = segment.index.size
        count = max(1, int(most * size / total) // length)
        for start in np.linspace(0, max(0, size - length), count).astype(int).tolist():
            out.append(Segment(segment.index[start : start + length], segment.values[start : start + length]))
    return out
