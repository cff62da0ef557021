"""The arm as rerun entities: what never changes once, what moves in columns of many pictures at once."""

from __future__ import annotations

import numpy as np
import rerun as rr

from sms_online.stream import Array
from sms_tools.view import style
from sms_tools.view.scene import Scene

ARM = "arm"
TIP = f"{ARM}/tip"
TIMELINE = "time"
# Sizes as shares of the arm's reach.
LINK_RADIUS, GHOST_RADIUS, JOINT_RADIUS, MARKER_RADIUS, TRAIL_RADIUS = 0.010, 0.004, 0.022, 0.015, 0.006


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
        center, half = scene.box
        stream.log(ARM, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        box = rr.Boxes3D(
            centers=[center],
            half_sizes=[half],
            colors=[style.BASE],
            labels=["spacecraft" if self._free else "fixed base"],
            show_labels=False,
            radii=GHOST_RADIUS * size,
        )
        stream.log(f"{ARM}/base", box, static=True)
        joints = rr.Points3D.from_fields(
            colors=[style.JOINT],
            radii=JOINT_RADIUS * size,
            labels=[f"joint {i}" for i in range(1, len(system.joints) + 1)],
            show_labels=False,
        )
        stream.log(f"{ARM}/joints", joints, static=True)
        line = rr.LineStrips3D.from_fields(colors=[style.LINK], radii=LINK_RADIUS * size)
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

    def write(self, t: Array, x: Array, residual: Array) -> None:
        """Pictures at t (B,), s, of positions x (B, n_x); residual (B, links): the relative one of each link's rows."""
        drawing = self._scene.draw(x)
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
            colors = style.residual_colors(residual[:, [i - 1 for i, _ in self._scene.markers]])
            columns = rr.Points3D.columns(
                positions=drawing.markers.reshape(-1, 3), colors=colors.reshape(-1, 3)
            ).partition(np.full(B, M))
            send(f"{ARM}/markers", index, columns)

    def _points(self, name: str, index: list[rr.TimeColumn], points: Array) -> None:
        B, n = points.shape[:2]
        columns = rr.Points3D.columns(positions=points.reshape(-1, 3)).partition(np.full(B, n))
        self._stream.send_columns(f"{ARM}/{name}", index, columns)

    def _strip(self, name: str, index: list[rr.TimeColumn], line: Array) -> None:
        self._stream.send_columns(f"{ARM}/{name}", index, rr.LineStrips3D.columns(strips=line.astype(np.float32)))
