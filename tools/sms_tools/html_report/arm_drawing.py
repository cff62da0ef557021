"""The arm at chosen instants: seen from above in the plane, obliquely in space."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull

from sms_online.stream import Array
from sms_tools.html_report.figures import Chart, drawn, ink
from sms_tools.view.scene import Scene

# Sizes, pt: of one of a row of pictures, and of a picture with places marked.
SMALL = (180.0, 150.0)
MARKED = (440.0, 300.0)
# Room about what is drawn, as a share of its extent, and below it for the scale.
MARGIN, BELOW = 0.08, 0.12
# A mark's text is so far above its place, pt.
ABOVE = 18.0
# Directions to the right and up on the paper: of a planar arm its own axes, of a spatial one seen from above one side.
PLANAR = np.array(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
OBLIQUE = np.array(((0.92, 0.40, 0.0), (-0.20, 0.46, 0.87)))
# Places of the tip that are drawn, at most.
WAY_POINTS = 200


def arm_drawings(scene: Scene, x: Array, chosen: Sequence[int], captions: Sequence[str]) -> list[Chart]:
    """Pictures of positions x (B, n_x) at chosen rows, all on one scale, with the tip's places in all rows behind."""
    arm = _Arm(scene, x, chosen, SMALL)
    return [
        Chart(caption, (), drawn(f"arm at {caption}", *SMALL, partial(arm.draw, row), bare=True))
        for row, caption in zip(chosen, captions, strict=True)
    ]


def marked_arm(scene: Scene, x: Array, row: int, marks: Mapping[str, str]) -> Markup:
    """One picture of a row of x (B, n_x) with places marked.

    marks: `joint_i`, `link_i`, `base` or `tip` to a mark's short text. The tip's places in all rows are behind.
    """
    arm = _Arm(scene, x, [row], MARKED)

    def draw(axes: Axes) -> None:
        arm.draw(row, axes)
        for place, text in marks.items():
            arm.mark(row, axes, place, text)

    return drawn("where", *MARKED, draw, bare=True)


class _Arm:
    """Pictures of positions x (B, n_x) on the paper, (..., 2), m, on one scale that holds the rows shown.

    size: of a picture, pt.
    """

    def __init__(self, scene: Scene, x: Array, shown: Sequence[int], size: tuple[float, float]) -> None:
        self.size = np.array(size)
        drawing = scene.draw(x)
        onto = (PLANAR if scene.model.layout.planar else OBLIQUE).T
        center, half = scene.box
        box = center + np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * half
        corners = drawing.base_origin[:, None] + np.einsum("bij,cj->bci", drawing.base_rotation, box)
        self.box, self.ghost = corners @ onto, drawing.ghost @ onto
        self.links = [line @ onto for line in drawing.links]
        self.joints, self.markers, self.tip = drawing.joints @ onto, drawing.markers @ onto, drawing.tip @ onto
        seen = [each[list(shown)].reshape(-1, 2) for each in (self.box, self.joints, *self.links)]
        points = np.concatenate([*seen, self.tip])
        self.low, self.high = points.min(axis=0), points.max(axis=0)

    def draw(self, row: int, axes: Axes) -> None:
        """Base, the tip's places, the rigid arm's ghost, links, joints and markers of a row, and the scale."""
        axes.add_patch(self._outline(row, color=ink("body")))
        way = self.tip[:: -(-len(self.tip) // WAY_POINTS)]
        axes.plot(*way.T, ".", color=ink("sky"), markersize=2.5)
        axes.plot(*self.ghost[row].T, color=ink("grey"), linewidth=1.0)
        for line in self.links:
            axes.plot(*line[row].T, color=ink("ink"), linewidth=3.0, solid_capstyle="round")
        axes.plot(*self.joints[row].T, "o", color=ink("orange"), markersize=7.0, markeredgewidth=0.0)
        axes.plot(*self.markers[row].T, "o", color=ink("green"), markersize=5.0, markeredgewidth=0.0)
        # A metre is as long to the right as it is up.
        extent = float((self.high - self.low).max())
        room = self.high - self.low + 2.0 * MARGIN * extent + np.array((0.0, BELOW * extent))
        half = self.size * float((room / self.size).max()) / 2.0
        middle = (self.low + self.high - np.array((0.0, BELOW * extent))) / 2.0
        (left, bottom), (right, top) = middle - half, middle + half
        axes.set(xlim=(left, right), ylim=(bottom, top))
        self._scale_bar(axes, left + MARGIN * extent, bottom + MARGIN * extent, extent)

    def mark(self, row: int, axes: Axes, place: str, text: str) -> None:
        """Mark a place with a text above it."""
        kind, _, number = place.partition("_")
        color = ink("mark")
        if kind == "link":
            line = self.links[int(number) - 1][row]
            axes.plot(*line.T, color=color, linewidth=12.0, alpha=0.35)
            at = line[len(line) // 2] if len(line) > 2 else line.mean(axis=0)
        elif kind == "base":
            axes.add_patch(self._outline(row, facecolor="none", edgecolor=color, linewidth=3.0))
            at = self.box[row].mean(axis=0)
        else:
            at = self.tip[row] if kind == "tip" else self.joints[row, int(number) - 1]
            axes.plot(*at, "o", markersize=16.0, color="none", markeredgecolor=color, markeredgewidth=3.0)
        box = {"boxstyle": "round,pad=0.4,rounding_size=0.7", "facecolor": color, "edgecolor": "none"}
        badge = axes.annotate(text, (at[0], at[1]), (0.0, ABOVE), textcoords="offset points", bbox=box)
        badge.set(ha="center", va="center", color=ink("ground"), weight="bold")

    def _outline(self, row: int, **look: Any) -> Polygon:
        """Outline of the base."""
        box = self.box[row]
        return Polygon(box[ConvexHull(box).vertices], **look)

    @staticmethod
    def _scale_bar(axes: Axes, left: float, y: float, extent: float) -> None:
        """A bar of a round length, at most a third of what is drawn."""
        power = 10.0 ** math.floor(math.log10(extent / 3.0))
        end = left + max(step * power for step in (1, 2, 5) if step * power <= extent / 3.0)
        axes.plot((left, end), (y, y), color=ink("muted"), linewidth=2.0)
        axes.annotate(f"{end - left:g} m", (end, y), (5.0, 0.0), textcoords="offset points", va="center")
