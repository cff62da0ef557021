"""Error bars from blocks of a session: what the estimates without each of them scatter by.

Forces that follow no law last, and what they leave in one span says little of what they leave in another. Error bars
that take innovations as independent are too small then, however much these are beyond their noise.
Source: Busing, Meijer, van der Leeden, Statistics and Computing 9 (1999) 3, for blocks of unequal size.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sms_online.stream import Array
from sms_online.trackers.factor import solve, triangular_factor

# Fewer blocks show no scatter; where there are as many as the most, neighbours merge.
FEWEST_BLOCKS, MOST_BLOCKS = 6, 24


class SpanBlock(NamedTuple):
    """Spans side by side: number of their rows, and their factor (n + 1, n + 1)."""

    rows: int
    factor: Array


def with_span(blocks: tuple[SpanBlock, ...], rows: int, factor: Array) -> tuple[SpanBlock, ...]:
    """The blocks, in order of time, with a span more; the two smallest neighbours merge where there are too many."""
    out = [*blocks, SpanBlock(rows, factor)]
    if len(out) > MOST_BLOCKS:
        k = min(range(len(out) - 1), key=lambda k: out[k].rows + out[k + 1].rows)
        one, other = out[k : k + 2]
        out[k : k + 2] = [SpanBlock(one.rows + other.rows, triangular_factor(one.factor, other.factor))]
    return tuple(out)


def jackknife_covariance(blocks: tuple[SpanBlock, ...], beforehand: Array) -> Array | None:
    """Covariance (n, n) of the estimate from the blocks and what is known beforehand, rows (·, n + 1).

    None where the blocks are too few. Zero for what the others do not determine without one of them.
    """
    if len(blocks) < FEWEST_BLOCKS:
        return None
    whole = solve(triangular_factor(beforehand, *(each.factor for each in blocks)))
    without = [
        solve(triangular_factor(beforehand, *(each.factor for each in blocks[:k] + blocks[k + 1 :])))
        for k in range(len(blocks))
    ]
    rows = np.array([each.rows for each in blocks])
    h = (rows.sum() / rows)[:, None]
    left_out = np.array([each.pi for each in without])
    values = h * whole.pi - (h - 1.0) * left_out
    middle = len(blocks) * whole.pi - np.sum((1.0 - 1.0 / h) * left_out, axis=0)
    apart = (values - middle) / np.sqrt(len(blocks) * (h - 1.0))
    apart[:, ~np.all([each.determined for each in without], axis=0)] = 0.0
    return np.asarray(apart.T @ apart)
