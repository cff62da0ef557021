"""Error bars about a reference, small enough for a cell of a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.stream import Array
from sms_tools.html_report.svg import svg

# Size of a picture and of each bar in it, px.
BAR_WIDTH, BAR_HEIGHT, STEP = 190, 16, 9
# The range of deviations, %, tried in this order until three quarters of them fit.
BAR_RANGES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
FITTING = 0.75


@dataclass(frozen=True)
class Bar:
    """Deviation from the reference and half length, %."""

    deviation: float
    bound: float
    color: str


def bar_range(reach: Array) -> float:
    """Half range, %, of an axis for bars that reach so far (·,) from the reference; NaN where there is no bar."""
    reach = reach[np.isfinite(reach)]
    fits = [limit for limit in BAR_RANGES if reach.size and np.mean(reach <= limit) >= FITTING]
    return fits[0] if fits else BAR_RANGES[-1]


def error_bars(bars: Sequence[Bar], limit: float) -> str:
    """Bars below each other on a scale of ± limit %, the reference in the middle; nothing where none is known."""
    bars = [bar for bar in bars if np.isfinite(bar.deviation) and np.isfinite(bar.bound)]
    if not bars:
        return ""
    center, height = BAR_WIDTH / 2, BAR_HEIGHT + STEP * (len(bars) - 1)
    grid, parts = [], []
    for k, bar in enumerate(bars):
        y = BAR_HEIGHT / 2 + STEP * k
        left, middle, right = (
            center + float(np.clip(value / limit, -1.0, 1.0)) * (center - 4)
            for value in (bar.deviation - bar.bound, bar.deviation, bar.deviation + bar.bound)
        )
        grid.append(f'<line class="grid" x1="4" x2="{BAR_WIDTH - 4}" y1="{y}" y2="{y}"/>')
        parts.append(
            f'<line x1="{left:.1f}" x2="{right:.1f}" y1="{y}" y2="{y}" stroke="{bar.color}" stroke-width="3"/>'
            f'<circle cx="{middle:.1f}" cy="{y}" r="3.5" fill="{bar.color}"/>'
        )
    axis = f'<line x1="{center}" x2="{center}" y1="1" y2="{height - 1}" stroke="#8895a3"/>'
    return svg(BAR_WIDTH, height, "".join([*grid, axis, *parts]))
