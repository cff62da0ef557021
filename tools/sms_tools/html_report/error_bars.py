"""Error bars about a reference, small enough for a cell of a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_tools.html_report.svg import svg

# Size of a picture and of each bar in it, px.
BAR_WIDTH, BAR_HEIGHT, STEP = 190, 16, 9


@dataclass(frozen=True)
class Bar:
    """Deviation from the reference and half length, %."""

    deviation: float
    bound: float
    color: str


def error_bars(bars: Sequence[Bar], limit: float) -> str:
    """Bars below each other on a scale of ± limit %, the reference in the middle; nothing where none is known.

    An arrow where one goes on beyond the scale.
    """
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
        if bar.deviation - bar.bound < -limit:
            parts.append(f'<path d="M0 {y} l7 -5 v10 z" fill="{bar.color}"/>')
        if bar.deviation + bar.bound > limit:
            parts.append(f'<path d="M{BAR_WIDTH} {y} l-7 -5 v10 z" fill="{bar.color}"/>')
    axis = f'<line x1="{center}" x2="{center}" y1="1" y2="{height - 1}" stroke="#8895a3"/>'
    return svg(BAR_WIDTH, height, "".join([*grid, axis, *parts]))
