"""The arm as rerun entities: what never changes once, what moves in columns of many pictures at once."""

from __future__ import annotations

import numpy as np
import rerun as rr

from sms_online.stream import Array
from sms_tools.view import style
from sms_tools.view.scene import Drawing, Scene

ARM = "arm"
TIP = f"{ARM}/tip"
TIMELINE = "time"
# Sizes as shares of the arm's reach.
LINK_RADIUS, GHOST_RADIUS, JOINT_RADIUS, MARKER_RADIUS, TRAIL_RADIUS = 0.010, 0.004, 0.022, 0.015, 0.006
MARK_RADIUS = 0.045
# A mark's text is so far above it, as a share of the reach, that it hides no marker's.
TEXT_OFFSET = 0.25


def times(t: Array) -> list[rr.TimeColumn]:
    """The index of pictures at t (B,), s."""
    return [rr.TimeColumn(TIMELINE, duration=t)]


class ArmLog:
    """Writes pictures of an arm into a recording."""

    def __init__(self, stream: rr.RecordingStream, scene: Scene) -> None:
        self._stream = stream
        self._scene = scene
        system = scene.model.system
        size = scene.reach
        self._free = system.spacecraft is not None
        self._joints, self._links = len(system.joints), len(system.links)
        self._marked: tuple[dict[str, str], style.Color] | None = None
        center, half = scene.box
        stream.log(ARM, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        box = rr.Boxes3D(
            centers=[center],
            half_sizes=[half],
            labels=["spacecraft" if self._free else "fixed base"],
            show_labels=False,
            radii=GHOST_RADIUS * size,
        )
        stream.log(f"{ARM}/base", box, static=True)
        joints = rr.Points3D.from_fields(
            radii=JOINT_RADIUS * size,
            labels=[f"joint {i}" for i in range(1, len(system.joints) + 1)],
            show_labels=False,
        )
        stream.log(f"{ARM}/joints", joints, static=True)
        line = rr.LineStrips3D.from_fields(radii=LINK_RADIUS * size)
        for i in range(1, len(system.links) + 1):
            stream.log(f"{ARM}/link_{i}", line, static=True)
        ghost = rr.LineStrips3D.from_fields(colors=[style.GHOST], radii=GHOST_RADIUS * size)
        stream.log(f"{ARM}/if_it_were_rigid", ghost, static=True)
        if scene.markers:
            labels = [f"{i}.{j}" for i, j in scene.markers]
            markers = rr.Points3D.from_fields(radii=MARKER_RADIUS * size, labels=labels, show_labels=True)
            stream.log(f"{ARM}/markers", markers, static=True)
        stream.log(TIP, rr.Points3D.from_fields(colors=[style.TIP], radii=TRAIL_RADIUS * size), static=True)
        if self._free:
            tracked = rr.Points3D.from_fields(
                colors=[style.TRACKED], radii=MARKER_RADIUS * size, labels=["S"], show_labels=True
            )
            stream.log(f"{ARM}/S", tracked, static=True)
        stream.log(f"{ARM}/marks", rr.Points3D.from_fields(radii=MARK_RADIUS * size), static=True)
        stream.log(f"{ARM}/mark_texts", rr.Points3D.from_fields(radii=0.0, show_labels=True), static=True)
        up = (0.0, 1.0, 0.0) if scene.model.layout.planar else (0.0, 0.0, 1.0)
        self._text_offset = TEXT_OFFSET * size * np.array(up)

    def write(self, t: Array, x: Array, residual: Array, marks: dict[str, str], color: style.Color) -> None:
        """Write pictures of the arm at t (B,), s.

        x (B, n_x): positions. residual (B, links): the relative one of each link's rows. marks: a text for each place
        (`joint_i`, `link_i`, `base`, `tip`) that is marked, in this colour.
        """
        drawing = self._scene.draw(x)
        if self._marked != (marks, color):
            self._paint(float(t[0]), marks, color)
            self._marked = marks, color
        if marks:
            at = np.stack([self._place(drawing, place) for place in marks], axis=1)
            self._points("marks", times(t), at)
            self._points("mark_texts", times(t), at + self._text_offset)
        index, B = times(t), t.size
        send = self._stream.send_columns
        if self._free:
            pose = rr.Transform3D.columns(translation=drawing.base_origin, mat3x3=drawing.base_rotation)
            send(f"{ARM}/base", index, pose)
            send(f"{ARM}/S", index, rr.Points3D.columns(positions=drawing.S))
        self._points("joints", index, drawing.joints)
        for i, line in enumerate(drawing.links, start=1):
            self._strip(f"link_{i}", index, line)
        self._strip("if_it_were_rigid", index, drawing.ghost)
        send(TIP, index, rr.Points3D.columns(positions=drawing.tip))
        M = len(self._scene.markers)
        if M:
            # A link on a fixed joint has no rows of a joint.
            known = np.pad(residual, ((0, 0), (0, self._links - residual.shape[1])), constant_values=np.nan)
            colors = style.residual_colors(known[:, [i - 1 for i, _ in self._scene.markers]])
            columns = rr.Points3D.columns(
                positions=drawing.markers.reshape(-1, 3), colors=colors.reshape(-1, 3)
            ).partition(np.full(B, M))
            send(f"{ARM}/markers", index, columns)

    def _paint(self, t: float, marks: dict[str, str], color: style.Color) -> None:
        """Colours of the arm's parts from t, s, on: those of the marked ones, and their texts."""
        index = times(np.array([t]))
        send = self._stream.send_columns
        joints = [color if f"joint_{i}" in marks else style.JOINT for i in range(1, self._joints + 1)]
        send(f"{ARM}/joints", index, rr.Points3D.columns(colors=joints).partition([len(joints)]))
        for i in range(1, self._links + 1):
            link = color if f"link_{i}" in marks else style.LINK
            send(f"{ARM}/link_{i}", index, rr.LineStrips3D.columns(colors=[link]))
        base = color if "base" in marks else style.BASE
        send(f"{ARM}/base", index, rr.Boxes3D.columns(colors=[base]))
        n = len(marks)
        nowhere, colors = np.zeros((n, 3)), [color] * n
        send(f"{ARM}/marks", index, rr.Points3D.columns(positions=nowhere, colors=colors).partition([n]))
        texts = rr.Points3D.columns(positions=nowhere, labels=list(marks.values()), colors=colors)
        send(f"{ARM}/mark_texts", index, texts.partition([n]))

    def _place(self, drawing: Drawing, place: str) -> Array:
        """Where a mark is drawn (B, 3)."""
        kind, _, number = place.partition("_")
        if kind == "joint":
            return drawing.joints[:, int(number) - 1]
        if kind == "link":
            line = drawing.links[int(number) - 1]
            return line[:, line.shape[1] // 2]
        if kind == "tip":
            return drawing.tip
        center, _ = self._scene.box
        return np.asarray(drawing.base_origin + drawing.base_rotation @ center)

    def _points(self, name: str, index: list[rr.TimeColumn], points: Array) -> None:
        B, n = points.shape[:2]
        columns = rr.Points3D.columns(positions=points.reshape(-1, 3)).partition(np.full(B, n))
        self._stream.send_columns(f"{ARM}/{name}", index, columns)

    def _strip(self, name: str, index: list[rr.TimeColumn], line: Array) -> None:
        self._stream.send_columns(f"{ARM}/{name}", index, rr.LineStrips3D.columns(strips=line.astype(np.float32)))
