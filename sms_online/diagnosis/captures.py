"""Several captures of one rig as one session: one after the other, with a pause between them.

A pause begins a new segment, so that each capture has its own initial states and windows; parameters are common.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

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
