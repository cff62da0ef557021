"""Drawings of signs: products of inertia, and the rotation that Euler parameters are of; computed as in the model."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from docs_site.conventions import COLORS, GREY, paper_line, paper_text, svg, triad
from sms_online.model import so3
from sms_online.model.chain import Frame
from sms_online.stream import Array

# Of the drawn rotation: axis, and angle in rad.
AXIS, ANGLE = np.array([-0.6, 0.0, 0.8]), 0.5
# kg and m of the drawn bodies: two masses on a rod each.
MASS, ARM = 1.0, np.array([0.3, 0.2])


def inertia_signs() -> str:
    """SVG of two bodies in the x-y plane with their products of inertia."""
    figure = Figure(figsize=(8.0, 2.2), layout="constrained")
    for axes, mirror in zip(figure.subplots(1, 2), (1.0, -1.0), strict=True):
        points = np.array([ARM, -ARM]) * (1.0, mirror)
        xy = -MASS * float(np.sum(points[:, 0] * points[:, 1]))
        _body(axes, points)
        axes.set_title(f"xy = −∫ x y dm = {xy:+.2f} kg m²".replace("-", "−"), fontsize=10)
    return svg(figure)


def _body(axes: Axes, points: Array) -> None:
    axes.plot(*points.T, color=GREY, linewidth=3.0)
    axes.plot(*points.T, "o", color="black", markersize=14)
    for point in points:
        text = f"{MASS:g} kg at ({point[0]:+g}, {point[1]:+g}) m".replace("-", "−")
        away = (0, 11 if point[1] > 0.0 else -19)
        axes.annotate(text, point, xytext=away, textcoords="offset points", fontsize=9, ha="center")
    for end, name, color in (((0.5, 0.0), "x", COLORS[0]), ((0.0, 0.35), "y", COLORS[1])):
        axes.annotate("", end, (0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": color, "linewidth": 1.5})
        axes.annotate(name, end, color=color, xytext=(4, 2), textcoords="offset points")
    axes.set_aspect("equal")
    axes.set_xlim(-0.7, 0.7)
    axes.set_ylim(-0.34, 0.42)
    axes.set_axis_off()


def euler_parameters() -> str:
    """SVG of an attitude: inertial axes, the axis of rotation, and {0} after it, with its Euler parameters."""
    eps, eta = np.sin(0.5 * ANGLE) * AXIS, float(np.cos(0.5 * ANGLE))
    R = so3.from_euler_parameters(eps[None], np.array([eta]))
    figure = Figure(figsize=(8.0, 2.6), layout="constrained")
    axes = figure.subplots()
    axes.set_axis_off()
    triad(axes, Frame(np.zeros((1, 3)), np.eye(3)[None]), "inertial", (-26, -12))
    other = np.array([1.0, 1.3, 0.0])
    triad(axes, Frame(other[None], R), "{0}", (-14, -14))
    for origin in (np.zeros(3), other):
        paper_line(axes, origin + np.outer((0.0, 0.5), AXIS), color=GREY, linestyle="-.")
    paper_text(axes, other + 0.5 * AXIS, f"n, the same in both: turn by φ = {ANGLE:g} rad, right-handed")
    values = ", ".join(f"{value:.3f}" for value in (*eps, eta)).replace("-", "−")
    axes.set_title(f"ε = n sin(φ/2), η = cos(φ/2): (eps_x, eps_y, eps_z, eta) = ({values})", fontsize=10)
    axes.set_aspect("equal")
    axes.set_xlim(-0.5, 3.6)
    axes.set_ylim(-0.4, 0.7)
    return svg(figure)
