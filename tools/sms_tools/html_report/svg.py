"""Line charts and drawings as SVG text.

Written here because a plotting library takes longer to be imported than a session takes to be replayed, and because
text in a page can be searched, copied and zoomed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from zlib import crc32

import numpy as np

from sms_online.stream import Array

# Size of a chart, and of what stands around its axes, px.
WIDTH, HEIGHT = 520, 260
LEFT, RIGHT, TOP, BOTTOM = 58, 12, 30, 38
# Marks of an axis, about so many.
TICKS = 5
# Okabe and Ito's colours, darkened where they vanish on white.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#56b4e9", "#444444", "#8c564b")


@dataclass(frozen=True)
class Series:
    """A line y (B,) over the chart's x, NaN where it has a gap, with bounds (B,) where there are some.

    x (B,): of its own where it has them. color: the next of COLORS unless given.
    """

    label: str
    y: Array
    lower: Array | None = None
    upper: Array | None = None
    dashed: bool = False
    x: Array | None = None
    color: str | None = None


@dataclass(frozen=True)
class Axis:
    """A linear axis from `low` to `high`, drawn from pixel `start` to pixel `end`."""

    low: float
    high: float
    start: float
    end: float

    def pixel(self, values: Array) -> Array:
        """Position of values, px."""
        return self.start + (values - self.low) / (self.high - self.low) * (self.end - self.start)

    def at(self, value: float) -> float:
        """Position of one value, px."""
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Round numbers within the axis."""
        span = self.high - self.low
        power = 10.0 ** math.floor(math.log10(span / TICKS))
        step = next(step for step in (power, 2 * power, 5 * power, 10 * power) if span / step <= TICKS + 1)
        first = math.ceil(self.low / step - 1e-9)
        return [k * step for k in range(first, math.floor(self.high / step + 1e-9) + 1)]


def chart(
    title: str,
    x: Array,
    series: Sequence[Series],
    x_label: str,
    y_range: tuple[float, float] | None = None,
    marks: Sequence[float] = (),
    shaded: Sequence[tuple[float, float]] = (),
) -> str:
    """A chart of lines over x (B,); without a range the y axis holds all lines, not their bounds.

    marks: at these x. shaded: from x to x.
    """
    span = (float(x[0]), float(x[-1])) if x.size > 1 else (0.0, 1.0)
    horizontal = Axis(*span, LEFT, WIDTH - RIGHT)
    vertical = Axis(*(y_range or _range(series)), HEIGHT - BOTTOM, TOP)
    parts = [f'<text class="title" x="{LEFT}" y="18">{escape(title)}</text>', _grid(horizontal, vertical, x_label)]
    parts[1:1] = [_span(horizontal, vertical, *span) for span in shaded]
    parts += [_line_at(horizontal, vertical, mark) for mark in marks]
    # Names must differ between the charts of a page and be the same each time it is made.
    name = f"clip{crc32(repr((title, span, [line.label for line in series])).encode())}"
    parts.append(
        f'<clipPath id="{name}"><rect x="{LEFT}" y="{TOP}" width="{WIDTH - LEFT - RIGHT}" '
        f'height="{HEIGHT - TOP - BOTTOM}"/></clipPath><g clip-path="url(#{name})">'
    )
    for k, line in enumerate(series):
        color = _color(series, k)
        pixels = horizontal.pixel(x if line.x is None else line.x)
        if line.lower is not None and line.upper is not None:
            parts.append(_band(pixels, vertical.pixel(line.lower), vertical.pixel(line.upper), color))
        parts.append(path(pixels, vertical.pixel(line.y), color, dashed=line.dashed))
    return svg(WIDTH, HEIGHT, "".join([*parts, "</g>", _legend(series)]))


def _color(series: Sequence[Series], k: int) -> str:
    return series[k].color or COLORS[k % len(COLORS)]


def svg(width: float, height: float, content: str) -> str:
    """A drawing of a size in px."""
    return f'<svg viewBox="0 0 {width:g} {height:g}" width="{width:g}" height="{height:g}" role="img">{content}</svg>'


def path(x: Array, y: Array, color: str, width: float = 1.6, dashed: bool = False) -> str:
    """A line through points (B,), px, interrupted where one is NaN."""
    pieces = [" ".join(f"{x[k]:.1f},{y[k]:.1f}" for k in run) for run in _runs(np.isfinite(y)) if len(run) > 1]
    dash = ' stroke-dasharray="5 4"' if dashed else ""
    return "".join(
        f'<polyline points="{piece}" fill="none" stroke="{color}" stroke-width="{width:g}"{dash}/>' for piece in pieces
    )


def _band(x: Array, lower: Array, upper: Array, color: str) -> str:
    pieces = []
    for run in _runs(np.isfinite(lower) & np.isfinite(upper)):
        outline = [f"{x[k]:.1f},{upper[k]:.1f}" for k in run] + [f"{x[k]:.1f},{lower[k]:.1f}" for k in run[::-1]]
        pieces.append(f'<polygon points="{" ".join(outline)}" fill="{color}" fill-opacity="0.13"/>')
    return "".join(pieces)


def _runs(known: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> list[list[int]]:
    """Indices of what is known, in uninterrupted pieces."""
    indices = np.flatnonzero(known)
    return [run.tolist() for run in np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1) if run.size]


def _range(series: Sequence[Series]) -> tuple[float, float]:
    values = np.concatenate([line.y for line in series]) if series else np.empty(0)
    values = values[np.isfinite(values)]
    if values.size == 0:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin


def _grid(horizontal: Axis, vertical: Axis, x_label: str) -> str:
    parts = []
    for tick in vertical.ticks():
        y = vertical.at(tick)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="tick" x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{tick:.4g}</text>')
    for tick in horizontal.ticks():
        x = horizontal.at(tick)
        parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>')
        parts.append(
            f'<text class="tick" x="{x:.1f}" y="{HEIGHT - BOTTOM + 15}" text-anchor="middle">{tick:.4g}</text>'
        )
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(f'<text class="tick" x="{middle:g}" y="{HEIGHT - 6}" text-anchor="middle">{escape(x_label)}</text>')
    return "".join(parts)


def _line_at(horizontal: Axis, vertical: Axis, mark: float) -> str:
    x = horizontal.at(mark)
    return f'<line class="mark" x1="{x:.1f}" x2="{x:.1f}" y1="{vertical.end}" y2="{vertical.start}"/>'


def _span(horizontal: Axis, vertical: Axis, start: float, end: float) -> str:
    left, right = horizontal.at(start), horizontal.at(end)
    size = f'width="{right - left:.1f}" height="{vertical.start - vertical.end:g}"'
    return f'<rect class="span" x="{left:.1f}" y="{vertical.end:g}" {size}/>'


def _legend(series: Sequence[Series]) -> str:
    """Labels in the upper right corner, each in the colour of its line."""
    x = WIDTH - RIGHT - 6
    parts = []
    for k, line in enumerate(series):
        color = _color(series, k)
        place = f'x="{x}" y="{TOP + 14 + 14 * k}"'
        parts.append(f'<text class="legend" {place} style="fill: {color}">{escape(line.label)}</text>')
    return "".join(parts)
