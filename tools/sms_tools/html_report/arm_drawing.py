"""The arm at chosen instants as SVG: seen from above in the plane, obliquely in space."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from scipy.spatial import ConvexHull

from sms_online.stream import Array
from sms_tools.html_report.svg import path, svg
from sms_tools.view.scene import Drawing, Scene

SIZE = 208  # px, of one picture
# A picture with places marked, px.
MARKED_WIDTH, MARKED_HEIGHT = 520, 330
MARGIN = 16.0  # px
# Directions to the right and up on the paper: of a planar arm its own axes, of a spatial one seen from above one side.
PLANAR = np.array(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
OBLIQUE = np.array(((0.92, 0.40, 0.0), (-0.20, 0.46, 0.87)))
BASE, LINK, GHOST, JOINT, MARKER, WAY = "#c9d2dc", "#1c2733", "#9aa7b5", "#d55e00", "#009e73", "#8fc1e3"
MARK = "#b4005a"


@dataclass(frozen=True)
class Paper:
    """A picture's projection.

    axes (2, 3): directions to the right and up. middle (2,), m; scale, px/m; extent: of all that is drawn, m.
    """

    axes: Array
    middle: Array
    scale: float
    extent: float
    width: float
    height: float

    def __call__(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3), m."""
        center = np.array((self.width, self.height)) / 2.0
        return np.asarray((points @ self.axes.T - self.middle) * self.scale * (1.0, -1.0) + center)


def arm_drawings(scene: Scene, x: Array, chosen: Sequence[int], captions: Sequence[str]) -> list[str]:
    """Pictures of positions x (B, n_x) at chosen rows, all on one scale, with the tip's places in all rows behind."""
    drawing = scene.draw(x)
    corners = _corners(scene, drawing)
    paper = _paper(scene, (corners[list(chosen)], *drawing.links, drawing.tip), SIZE, SIZE)
    out = []
    for row, caption in zip(chosen, captions, strict=True):
        parts = _arm(paper, drawing, corners, row)
        picture = svg(SIZE, SIZE, "".join([*parts, _scale_bar(paper)]))
        out.append(f"<figure>{picture}<figcaption>{caption}</figcaption></figure>")
    return out


def marked_arm(scene: Scene, x: Array, row: int, marks: Mapping[str, str]) -> str:
    """One picture of a row of x (B, n_x) with places marked: `joint_i`, `link_i`, `base`, `tip` to a mark's short text.

    The tip's places in all rows stand behind.
    """
    drawing = scene.draw(x)
    corners = _corners(scene, drawing)
    shown = (corners[[row]], *(line[row] for line in drawing.links), drawing.tip)
    paper = _paper(scene, shown, MARKED_WIDTH, MARKED_HEIGHT)
    parts, badges = _arm(paper, drawing, corners, row), []
    for place, text in marks.items():
        kind, _, number = place.partition("_")
        if kind == "link":
            line = paper(drawing.links[int(number) - 1][row])
            parts.append(f'<g opacity="0.35">{_line(line, MARK, 12.0)}</g>')
            at = line[len(line) // 2]
        elif kind == "base":
            parts.append(
                f'<polygon points="{_outline(paper(corners[row]))}" fill="none" stroke="{MARK}" stroke-width="3"/>'
            )
            at = paper(corners[row]).mean(axis=0)
        else:
            at = paper(drawing.tip[row] if kind == "tip" else drawing.joints[row, int(number) - 1])
            parts.append(
                f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="9" fill="none" stroke="{MARK}" stroke-width="3"/>'
            )
        badges.append(_badge(at, text, paper))
    return svg(MARKED_WIDTH, MARKED_HEIGHT, "".join([*parts, *badges, _scale_bar(paper)]))


def _paper(scene: Scene, shown: Sequence[Array], width: float, height: float) -> Paper:
    """A picture that holds all points shown, each (..., 3)."""
    axes = PLANAR if scene.model.layout.planar else OBLIQUE
    flat = np.concatenate([(points @ axes.T).reshape(-1, 2) for points in shown])
    low, high = flat.min(axis=0), flat.max(axis=0)
    scale = float(np.min((np.array((width, height)) - 2 * MARGIN) / np.maximum(high - low, 1e-9)))
    return Paper(axes, (low + high) / 2.0, scale, float((high - low).max()), width, height)


def _arm(paper: Paper, drawing: Drawing, corners: Array, row: int) -> list[str]:
    """Base, the tip's places, the rigid arm's ghost, links, joints and markers of a row."""
    parts = [f'<polygon points="{_outline(paper(corners[row]))}" fill="{BASE}"/>']
    parts += [_dot(point, WAY, 1.0) for point in paper(drawing.tip)]
    parts.append(_line(paper(drawing.ghost[row]), GHOST, 1.0))
    parts += [_line(paper(line[row]), LINK, 3.0) for line in drawing.links]
    parts += [_dot(point, JOINT, 4.0) for point in paper(drawing.joints[row])]
    return parts + [_dot(point, MARKER, 3.0) for point in paper(drawing.markers[row])]


def _outline(box: Array) -> str:
    """Points of the outline of a box's corners (8, 2), px."""
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in box[ConvexHull(box).vertices])


def _badge(at: Array, text: str, paper: Paper) -> str:
    """A text in a frame above a place, or below it where there is no room."""
    width = 10.0 + 7.0 * len(text)
    x = float(np.clip(at[0], width / 2.0, paper.width - width / 2.0))
    y = at[1] + (-26.0 if at[1] > 44.0 else 26.0)
    return (
        f'<rect x="{x - width / 2.0:.1f}" y="{y - 9:.1f}" width="{width:.1f}" height="18" rx="9" fill="{MARK}"/>'
        f'<text class="badge" x="{x:.1f}" y="{y + 4:.1f}">{escape(text)}</text>'
    )


def _corners(scene: Scene, drawing: Drawing) -> Array:
    """Corners (B, 8, 3) of the base's box."""
    center, half = scene.box
    local = center + np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * half
    return np.asarray(drawing.base_origin[:, None] + np.einsum("bij,cj->bci", drawing.base_rotation, local))


def _line(points: Array, color: str, width: float) -> str:
    return path(points[:, 0], points[:, 1], color, width)


def _dot(point: Array, color: str, radius: float) -> str:
    return f'<circle cx="{point[0]:.1f}" cy="{point[1]:.1f}" r="{radius:g}" fill="{color}"/>'


def _scale_bar(paper: Paper) -> str:
    """A bar of a round length, at most a third of what is drawn."""
    power = 10.0 ** math.floor(math.log10(paper.extent / 3.0))
    length = max(step * power for step in (1, 2, 5) if step * power <= paper.extent / 3.0)
    end = MARGIN + length * paper.scale
    y = paper.height - 6.0
    return (
        f'<line x1="{MARGIN:g}" x2="{end:.1f}" y1="{y:g}" y2="{y:g}" stroke="#444" stroke-width="2"/>'
        f'<text class="tick" x="{end + 5:.1f}" y="{y + 3:g}">{length:g} m</text>'
    )
