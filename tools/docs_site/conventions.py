"""Drawings of the frames of a spatial arm and of what a marker reads, made by the model's own kinematics."""

from __future__ import annotations

import io

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sms_online.description.bodies import FlexibleLink
from sms_online.description.parse import parse_system, shipped_text
from sms_online.effects.build import build_model
from sms_online.model.chain import Configuration, Frame
from sms_online.model.model import Model
from sms_online.stream import Array

# x, y, z of every frame; all three are seen on white and on black paper.
COLORS = ("#c0392b", "#1e8449", "#2471a3")
GREY = "#7f8c8d"
LENGTH = 0.32  # m, of a frame's axes as drawn
# Directions of view: the rows are right and up on the paper, of an observer in front, to the right and above.
VIEW = np.array([[0.55, 0.83, 0.0], [-0.38, 0.25, 0.89]])


def spatial_frames() -> str:
    """SVG of the frames of the shipped system spatial-two-link, bent and turned so that none hides another."""
    model = build_model(parse_system(shipped_text("spatial-two-link"), "spatial-two-link"))
    x = _position(
        model,
        {"r_S_x": 0.55, "r_S_y": 0.45, "r_S_z": 0.9, "eta": 1.0, "q_1": 0.6, "q_2": -1.0}
        | {f"link_{i}.marker_{j}.{name}": value * j**2 for i in (1, 2) for j in (1, 2) for name, value in BENT.items()},
    )  # fmt: skip
    configuration = model.chain.configure(x)
    figure, axes = _paper(8.0, 3.4)
    frames = configuration.frames
    _base(axes, model, configuration, frames)
    _links(axes, model, configuration)
    for k, name, offset in ((2, "{1}", (16, -22)), (4, "{2}", (20, -12)), (5, "tip", (22, 4))):
        triad(axes, frames[k], name, offset)
    for i, reach in ((1, 0.75), (2, -0.75)):
        mount, axis = frames[2 * i - 1], model.chain.axes[i - 1]
        paper_line(
            axes,
            mount.origin[0] + np.outer((-0.4 * reach, reach), mount.rotation[0] @ axis),
            color=GREY,
            linestyle="-.",
        )
        paper_text(axes, mount.origin[0] + reach * mount.rotation[0] @ axis, f"axis of joint {i}")
    axes.set_aspect("equal")
    return svg(figure)


# Nodal coordinates of both links at the first marker; four times as much at the second, the tip.
BENT = {"u_y": 0.04, "theta_z": 0.08, "u_z": 0.03, "theta_y": -0.06, "theta_x": 0.05}


def _base(axes: Axes, model: Model, configuration: Configuration, frames: list[Frame]) -> None:
    """Inertial frame, spacecraft, tracked point S and frame {0}."""
    spacecraft = model.system.spacecraft
    assert spacecraft is not None
    origin, rotation = frames[0].origin[0], frames[0].rotation[0]
    triad(axes, Frame(np.zeros((1, 3)), np.eye(3)[None]), "inertial", (-34, -4))
    triad(axes, frames[0], "{0}", (-12, -14))
    S = configuration.r_S[0]
    center = np.array(spacecraft.center_of_mass)
    low, high = center - np.abs(center), center + np.abs(center)
    for a in range(3):
        for corner in range(4):
            ends = np.array([low, low])
            ends[1, a] = high[a]
            for b, bit in zip([k for k in range(3) if k != a], (corner & 1, corner >> 1), strict=True):
                ends[:, b] = high[b] if bit else low[b]
            paper_line(axes, origin + ends @ rotation.T, color=GREY, linewidth=0.8)
    paper_line(axes, np.array([origin, S]), color=GREY, linestyle=":")
    paper_line(axes, np.array([np.zeros(3), S]), color="black", linewidth=0.9)
    paper_text(axes, 0.45 * S, "r$_S$")
    paper_text(axes, 0.35 * S + 0.65 * origin, "tracked_point")
    axes.plot(*_seen(S), "ko", markersize=5)
    triad(axes, Frame(S[None], frames[0].rotation), "S", (-8, 4))


def _links(axes: Axes, model: Model, configuration: Configuration) -> None:
    """The links' centre lines, straight and bent, and their markers."""
    for i, kinematics in enumerate(model.chain.flexible):
        shape, link = configuration.shape(i), model.system.links[i]
        assert kinematics is not None
        assert shape is not None
        assert isinstance(link, FlexibleLink)
        frame = configuration.frames[2 * i + 2]
        origin, rotation = frame.origin[0], frame.rotation[0]
        points = np.vstack((np.zeros(3), shape.points[0], shape.tip[0]))
        paper_line(axes, origin + np.outer(np.array([0.0, link.length]), rotation[:, 0]), color=GREY, linestyle="--")
        paper_line(axes, origin + points @ rotation.T, color="black", linewidth=2.5)
        readings = dict(
            zip(kinematics.marker_names, kinematics.markers(model.chain.elastic(configuration.x, i))[0], strict=True)
        )
        for j in range(1, link.elements + 1):
            straight = link.length * j / link.elements
            at = origin + rotation @ np.array([straight, *(readings[f"marker_{j}.{u}"] for u in ("u_y", "u_z"))])
            axes.plot(*_seen(at), "o", color="#d68910", markersize=7, zorder=5)
            if j < link.elements:
                paper_text(axes, at, f"marker_{j} of link_{i + 1}", color="#9c640c", offset=((-24, -26), (6, -14))[i])


def link_conventions() -> str:
    """SVG of one link bent in both planes of its frame, with the signs of what its markers read."""
    system = parse_system(shipped_text("spatial-two-link"), "spatial-two-link")
    model = build_model(system)
    kinematics, link = model.chain.flexible[0], system.links[0]
    assert kinematics is not None
    assert isinstance(link, FlexibleLink)
    figure = Figure(figsize=(8.0, 2.1), layout="constrained")
    readings = {"u_y": 0.07, "theta_z": 0.13, "u_z": 0.07, "theta_y": -0.13}
    bent = {f"marker_{j}.{name}": value * (1.0, 2.9)[j - 1] for j in (1, 2) for name, value in readings.items()}
    q_f = np.array([[bent.get(name, 0.0) for name in kinematics.marker_names]])
    shape = kinematics.shape(q_f)
    for plane, (axes, up, u, theta, deformation) in enumerate(
        zip(figure.subplots(1, 2), (1, 2), ("u_y", "u_z"), ("θ_z", "θ_y"), ("bending_z", "bending_y"), strict=True)
    ):
        _plane(
            axes,
            link.length,
            shape.points[0][:, [0, up]],
            shape.tip[0][[0, up]],
            shape.tip_rotation[0][[0, up], 0],
        )
        sign = "> 0" if plane == 0 else "< 0"
        axes.set_title(f"{deformation}: {u} > 0, {theta} {sign} as drawn", fontsize=10)
        axes.annotate("xyz"[up], (0.0, 0.33), color=COLORS[up], ha="center", va="bottom")
        L, tip = link.length, shape.tip[0][up]
        axes.annotate("", (L, tip), (L, 0.0), arrowprops={"arrowstyle": "->", "color": COLORS[up]})
        axes.annotate(u, (L + 0.03, 0.45 * tip), color=COLORS[up])
        out = "y into the paper" if plane == 1 else "z out of the paper"
        axes.annotate(f"{theta} turns about {out}", (0.5 * L, -0.14), ha="center", color=GREY, fontsize=9)
    return svg(figure)


def _plane(axes: Axes, length: float, points: Array, tip: Array, tangent: Array) -> None:
    """A link in one plane of its frame: straight and bent, its markers, and the section's tangent at the tip."""
    axes.plot([0.0, length], [0.0, 0.0], "--", color=GREY, linewidth=1.0)
    line = np.vstack((np.zeros(2), points, tip))
    axes.plot(*line.T, color="black", linewidth=2.5)
    axes.plot([-0.03, -0.03], [-0.08, 0.08], color="black", linewidth=4.0)
    for j in (1, 2):
        at = 0.5 * j * length
        axes.plot([at], [np.interp(at, *line.T)], "o", color="#d68910", markersize=7, zorder=5)
        axes.annotate(f"marker_{j}", (at, np.interp(at, *line.T) + 0.05), ha="right", color="#9c640c", fontsize=9)
    axes.plot(*np.array([tip, tip + 0.3 * tangent / np.linalg.norm(tangent)]).T, color="#8e44ad", linewidth=1.2)
    axes.plot([tip[0], tip[0] + 0.3], [tip[1], tip[1]], ":", color="#8e44ad", linewidth=1.2)
    for end, color in (((0.32, 0.0), COLORS[0]), ((0.0, 0.32), None)):
        if color is not None:
            axes.annotate("", end, (0.0, 0.0), arrowprops={"arrowstyle": "->", "color": color, "linewidth": 1.6})
    axes.annotate("x", (0.33, -0.03), color=COLORS[0], va="top")
    axes.annotate("", (0.0, 0.33), (0.0, 0.0), arrowprops={"arrowstyle": "->", "color": "black", "linewidth": 1.6})
    axes.set_aspect("equal")
    axes.set_xlim(-0.12, length + 0.42)
    axes.set_ylim(-0.2, 0.48)
    axes.set_axis_off()


def _position(model: Model, values: dict[str, float]) -> Array:
    return np.array([[values.get(name, 0.0) for name in model.layout.position_names]])


def _paper(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots()
    axes.set_axis_off()
    return figure, axes


def _seen(point: Array) -> tuple[float, float]:
    """A point (3,) on the paper, in parallel projection."""
    right, up = VIEW @ point
    return float(right), float(up)


def paper_line(axes: Axes, points: Array, **style: object) -> None:
    """A line through points (n, 3), seen from VIEW."""
    axes.plot(*(points @ VIEW.T).T, **({"linewidth": 1.0} | style))  # type: ignore[arg-type]


def paper_text(axes: Axes, at: Array, text: str, color: str = "black", offset: tuple[int, int] = (4, 2)) -> None:
    """A text beside a point (3,)."""
    axes.annotate(text, _seen(at), xytext=offset, textcoords="offset points", color=color, fontsize=9)


def triad(axes: Axes, frame: Frame, name: str, offset: tuple[int, int]) -> None:
    """The axes of a frame, red x, green y, blue z, and its name so far from its origin, points."""
    origin = frame.origin[0]
    for a, color in enumerate(COLORS):
        end = origin + LENGTH * frame.rotation[0][:, a]
        arrow = {"arrowstyle": "-|>", "color": color, "linewidth": 1.5, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", _seen(end), _seen(origin), arrowprops=arrow)
        axes.annotate(
            "xyz"[a],
            _seen(origin + 1.15 * LENGTH * frame.rotation[0][:, a]),
            color=color,
            fontsize=8,
            ha="center",
            va="center",
        )
    axes.annotate(
        name, _seen(origin), xytext=offset, textcoords="offset points", fontsize=10, weight="bold", ha="center"
    )


def svg(figure: Figure) -> str:
    """Text of a figure, the same whenever it is made."""
    text = io.StringIO()
    # Text stays text, in the reader's own font; no dates, so that the same code makes the same file.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "sms-online", "font.family": "sans-serif"}):
        figure.savefig(text, format="svg", metadata={"Date": None}, facecolor="white")
    return text.getvalue()
