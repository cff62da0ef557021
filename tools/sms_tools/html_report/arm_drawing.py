"""The arm at chosen instants as SVG: seen from above in the plane, obliquely in space."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull

from sms_online.stream import Array
from sms_tools.html_report.svg import path, svg
from sms_tools.view.scene import Drawing, Scene

SIZE = 208  # px, of one picture
MARGIN = 16.0  # px
# Directions to the right and up on the paper: of a planar arm its own axes, of a spatial one seen from above one side.
PLANAR = np.array(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
OBLIQUE = np.array(((0.92, 0.40, 0.0), (-0.20, 0.46, 0.87)))
BASE, LINK, GHOST, JOINT, MARKER, WAY = "#c9d2dc", "#1c2733", "#9aa7b5", "#d55e00", "#009e73", "#8fc1e3"


def arm_drawings(scene: Scene, x: Array, chosen: Sequence[int], captions: Sequence[str]) -> list[str]:
    """Pictures of positions x (B, n_x) at chosen rows, all on one scale, with the tip's places in all rows behind."""
    drawing = scene.draw(x)
    axes = PLANAR if scene.model.layout.planar else OBLIQUE
    corners = _corners(scene, drawing)
    seen = [(points @ axes.T).reshape(-1, 2) for points in (corners[list(chosen)], *drawing.links, drawing.tip)]
    low, high = (edge(np.concatenate(seen), axis=0) for edge in (np.min, np.max))
    size = float((high - low).max())
    scale = (SIZE - 2 * MARGIN) / size
    middle = (low + high) / 2.0

    def paper(points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3), m."""
        return np.asarray((points @ axes.T - middle) * scale * (1.0, -1.0) + SIZE / 2.0)

    way = "".join(_dot(point, WAY, 1.0) for point in paper(drawing.tip))
    out = []
    for row, caption in zip(chosen, captions, strict=True):
        box = paper(corners[row])
        outline = box[ConvexHull(box).vertices]
        text = " ".join(f"{a:.1f},{b:.1f}" for a, b in outline)
        parts = [f'<polygon points="{text}" fill="{BASE}"/>', way, _line(paper(drawing.ghost[row]), GHOST, 1.0)]
        parts += [_line(paper(line[row]), LINK, 3.0) for line in drawing.links]
        parts += [_dot(point, JOINT, 4.0) for point in paper(drawing.joints[row])]
        parts += [_dot(point, MARKER, 3.0) for point in paper(drawing.markers[row])]
        picture = svg(SIZE, SIZE, "".join([*parts, _scale_bar(scale, size)]))
        out.append(f"<figure>{picture}<figcaption>{caption}</figcaption></figure>")
    return out


def _corners(scene: Scene, drawing: Drawing) -> Array:
    """Corners (B, 8, 3) of the base's box."""
    center, half = scene.box
    local = center + np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * half
    return np.asarray(drawing.base_origin[:, None] + np.einsum("bij,cj->bci", drawing.base_rotation, local))


def _line(points: Array, color: str, width: float) -> str:
    return path(points[:, 0], points[:, 1], color, width)


def _dot(point: Array, color: str, radius: float) -> str:
    return f'<circle cx="{point[0]:.1f}" cy="{point[1]:.1f}" r="{radius:g}" fill="{color}"/>'


def _scale_bar(scale: float, size: float) -> str:
    """A bar of a round length, at most a third of the picture."""
    power = 10.0 ** math.floor(math.log10(size / 3.0))
    length = max(step * power for step in (1, 2, 5) if step * power <= size / 3.0)
    end = MARGIN + length * scale
    y = SIZE - 6.0
    return (
        f'<line x1="{MARGIN:g}" x2="{end:.1f}" y1="{y:g}" y2="{y:g}" stroke="#444" stroke-width="2"/>'
        f'<text class="tick" x="{end + 5:.1f}" y="{y + 3:g}">{length:g} m</text>'
    )
