"""The arm at chosen instants: seen from above in the plane, obliquely in space."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull

from sms_online.stream import Array
from sms_tools.html_report.figures import Chart, drawn, ink
from sms_tools.view.scene import Drawing, Scene

# Sizes, pt: of one of a row of pictures, and of a picture with places marked.
SMALL = (180.0, 150.0)
MARKED = (440.0, 300.0)
MARGIN = 16.0  # pt
# A mark's text is so far above its place, pt.
ABOVE = 18.0
# Directions to the right and up on the paper: of a planar arm its own axes, of a spatial one seen from above one side.
PLANAR = np.array(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
OBLIQUE = np.array(((0.92, 0.40, 0.0), (-0.20, 0.46, 0.87)))
# Places of the tip that are drawn, at most.
WAY_POINTS = 200


@dataclass(frozen=True)
class Paper:
    """A picture's projection onto axes (2, 3) about a middle (2,), m; size, pt; extent: of what is drawn, m."""

    axes: Array
    middle: Array
    size: tuple[float, float]
    scale: float  # m/pt
    extent: float

    def __call__(self, points: Array) -> Array:
        """Places (2, ...) of points (..., 3), m."""
        return np.moveaxis(points @ self.axes.T, -1, 0)


def arm_drawings(scene: Scene, x: Array, chosen: Sequence[int], captions: Sequence[str]) -> list[Chart]:
    """Pictures of positions x (B, n_x) at chosen rows, all on one scale, with the tip's places in all rows behind."""
    drawing = scene.draw(x)
    corners = _corners(scene, drawing)
    paper = _paper(scene, (corners[list(chosen)], *drawing.links, drawing.tip), SMALL)
    pictures = []
    for row, caption in zip(chosen, captions, strict=True):
        draw = partial(_arm, paper=paper, drawing=drawing, corners=corners, row=row)
        pictures.append(Chart(caption, (), drawn(f"arm at {caption}", *SMALL, draw, bare=True)))
    return pictures


def marked_arm(scene: Scene, x: Array, row: int, marks: Mapping[str, str]) -> Markup:
    """One picture of a row of x (B, n_x) with places marked: `joint_i`, `link_i`, `base`, `tip` to a mark's short text.

    The tip's places in all rows are behind.
    """
    drawing = scene.draw(x)
    corners = _corners(scene, drawing)
    shown = (corners[[row]], *(line[row] for line in drawing.links), drawing.tip)
    paper = _paper(scene, shown, MARKED)

    def draw(axes: Axes) -> None:
        _arm(axes, paper, drawing, corners, row)
        for place, text in marks.items():
            kind, _, number = place.partition("_")
            if kind == "link":
                line = paper(drawing.links[int(number) - 1][row])
                axes.plot(*line, color=ink("mark"), linewidth=12.0, alpha=0.35)
                at = line[:, line.shape[1] // 2] if line.shape[1] > 2 else line.mean(axis=1)
            elif kind == "base":
                axes.add_patch(_outline(paper(corners[row]), facecolor="none", edgecolor=ink("mark"), linewidth=3.0))
                at = paper(corners[row]).mean(axis=1)
            else:
                at = paper(drawing.tip[row] if kind == "tip" else drawing.joints[row, int(number) - 1])
                axes.plot(*at, "o", markersize=16.0, color="none", markeredgecolor=ink("mark"), markeredgewidth=3.0)
            box = {"boxstyle": "round,pad=0.4,rounding_size=0.7", "facecolor": ink("mark"), "edgecolor": "none"}
            badge = {"ha": "center", "va": "center", "color": ink("ground"), "weight": "bold", "bbox": box}
            axes.annotate(text, (at[0], at[1]), (0.0, ABOVE), textcoords="offset points", **badge)

    return drawn("where", *MARKED, draw, bare=True)


def _paper(scene: Scene, shown: Sequence[Array], size: tuple[float, float]) -> Paper:
    """A picture that holds all points shown, each (..., 3)."""
    axes = PLANAR if scene.model.layout.planar else OBLIQUE
    flat = np.concatenate([(points @ axes.T).reshape(-1, 2) for points in shown])
    low, high = flat.min(axis=0), flat.max(axis=0)
    # Twice the margin above and below, for marks and the scale.
    room = np.array(size) - MARGIN * np.array((2.0, 4.0))
    scale = float(np.max(np.maximum(high - low, 1e-9) / room))
    return Paper(axes, (low + high) / 2.0, size, scale, float((high - low).max()))


def _arm(axes: Axes, paper: Paper, drawing: Drawing, corners: Array, row: int) -> None:
    """Base, the tip's places, the rigid arm's ghost, links, joints and markers of a row, and the scale."""
    axes.add_patch(_outline(paper(corners[row]), color=ink("body")))
    way = paper(drawing.tip)[:, :: -(-len(drawing.tip) // WAY_POINTS)]
    axes.plot(*way, ".", color=ink("sky"), markersize=2.5)
    axes.plot(*paper(drawing.ghost[row]), color=ink("grey"), linewidth=1.0)
    for line in drawing.links:
        axes.plot(*paper(line[row]), color=ink("ink"), linewidth=3.0, solid_capstyle="round")
    axes.plot(*paper(drawing.joints[row]), "o", color=ink("orange"), markersize=7.0, markeredgewidth=0.0)
    axes.plot(*paper(drawing.markers[row]), "o", color=ink("green"), markersize=5.0, markeredgewidth=0.0)
    half = np.array(paper.size) * paper.scale / 2.0
    axes.set_xlim(paper.middle[0] - half[0], paper.middle[0] + half[0])
    axes.set_ylim(paper.middle[1] - half[1], paper.middle[1] + half[1])
    _scale_bar(axes, paper)


def _outline(box: Array, **look: Any) -> Polygon:
    """The outline of a box's corners (2, 8)."""
    return Polygon(box.T[ConvexHull(box.T).vertices], **look)


def _corners(scene: Scene, drawing: Drawing) -> Array:
    """Corners (B, 8, 3) of the base's box."""
    center, half = scene.box
    local = center + np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * half
    return np.asarray(drawing.base_origin[:, None] + np.einsum("bij,cj->bci", drawing.base_rotation, local))


def _scale_bar(axes: Axes, paper: Paper) -> None:
    """A bar of a round length, at most a third of what is drawn."""
    power = 10.0 ** math.floor(math.log10(paper.extent / 3.0))
    length = max(step * power for step in (1, 2, 5) if step * power <= paper.extent / 3.0)
    left, bottom = axes.get_xlim()[0] + MARGIN * paper.scale, axes.get_ylim()[0] + MARGIN / 2.0 * paper.scale
    axes.plot((left, left + length), (bottom, bottom), color=ink("muted"), linewidth=2.0)
    axes.annotate(f"{length:g} m", (left + length, bottom), (5.0, 0.0), textcoords="offset points", va="center")
