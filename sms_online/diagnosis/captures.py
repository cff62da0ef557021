"""Captures as a session takes them: with mistakes undone, and several of one rig one after the other, a pause between.

A pause begins a new segment, so that each capture has its own initial states and windows; parameters are common.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import numpy as np

from sms_online.diagnosis.mistakes import Corrected
from sms_online.pipeline.periods import LONGEST_HOLE
from sms_online.stream import Block

# Pause between two captures, s: nothing is interpolated across it.
PAUSE = 2.0 * LONGEST_HOLE


def one_after_another(runs: Sequence[Sequence[Block]]) -> list[Sequence[Block]]:
    """Blocks of captures, each behind a pause after the one before."""
    out = [runs[0]]
    for run in runs[1:]:
        end = out[-1][-1].t[-1]
        later = end + PAUSE - run[0].t[0]
        out.append([Block(block.t + later, block.channels, block.values) for block in run])
    return out


def begins(runs: Sequence[Sequence[Block]]) -> tuple[float, ...]:
    """Times in the pauses before all captures but the first, s after the first sample of the first."""
    first = next(iter(chain.from_iterable(runs))).t[0]
    return tuple(float(run[0].t[0] - first - 0.5 * PAUSE) for run in runs[1:])


def in_seconds(blocks: Sequence[Block], unit: float) -> list[Block]:
    """Blocks whose stamps were so many a second."""
    return [Block(block.t / unit, block.channels, block.values) for block in blocks]


def undone(blocks: Sequence[Block], corrected: Corrected) -> list[Block]:
    """Blocks without the mistakes found, as one: an encoder is unwrapped from its first sample on."""
    if not blocks:
        return []
    t, values = (np.concatenate([getattr(block, part) for block in blocks]) for part in ("t", "values"))
    return [Block(t, blocks[0].channels, corrected.samples(blocks[0].channels, values))]
