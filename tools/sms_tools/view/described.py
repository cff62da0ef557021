"""The described arm in rerun before there are any data: its frames, joints, markers, and channels by place."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sms_online.description.channels import channels
from sms_online.description.given import Given, given_system
from sms_online.description.schema import System
from sms_online.description.tree import mounts
from sms_online.effects.build import build_model
from sms_online.errors import InputError
from sms_online.model.model import Model
from sms_online.stream import Array
from sms_tools.interruption import Interruption
from sms_tools.view.choice import EXPECTED, chosen
from sms_tools.view.scene import Scene
from sms_tools.view.session import RECORDING, absent

if TYPE_CHECKING:
    import rerun.blueprint as rrb

    from sms_tools.view.sink import Sink

FRAMES, CHANNELS, TEXT = "arm/frames", "arm/channels", "channels"
# Axes of a frame, as a share of the arm's reach, and their colours as the documentation has them.
AXIS_LENGTH, AXIS_RADIUS = 0.09, 0.004
COLORS = ((214, 39, 40), (44, 160, 44), (31, 119, 180))


@dataclass(frozen=True)
class Row:
    """Channels that are measured at a place: `base`, `joint_i` or `link_i`."""

    place: str
    channels: tuple[str, ...]


def channel_table(system: System) -> list[Row]:
    """All channels that a capture of the system may hold, by where they are measured."""
    names = channels(system)
    moving = [f"joint_{i}" for i in range(1, len(system.joints) + 1)]
    at = {place: tuple(n for n in names if "." not in n and n.endswith(f"_{place[6:]}")) for place in moving}
    at |= {f"link_{i}": tuple(n for n in names if n.startswith(f"link_{i}.")) for i in range(1, len(system.links) + 1)}
    held = {name for every in at.values() for name in every}
    base = Row("base", tuple(name for name in names if name not in held))
    return [row for row in (base, *(Row(place, every) for place, every in at.items())) if row.channels]


def show(
    system: Given,
    *,
    rerun: str = "spawn",
    directory: str | Path = "runs/show",
    exaggeration: float = 1.0,
) -> str:
    """Open a described system in rerun, at rest; returns where it is to be seen.

    system: described, or the name of a shipped one or the path of a file. rerun: `off`, `save` (to session.rrd in
    `directory`), `serve`, `serve=ADDRESS`, `spawn` or `connect=URL`, as of the command line; what is served stays until
    Ctrl-C. exaggeration: factor on deflections. Raises InputError on an unknown choice, where no viewer is, and where
    nothing can be written.
    """
    system, _ = given_system(system)
    choice = chosen(rerun)
    if choice.kind == "off":
        return "no view"
    if choice.kind == "connect" and (missing := absent(choice)):
        raise InputError("--rerun", "", missing, "a viewer that runs there")
    # rerun takes a second to be imported, which nobody should wait for who asks for no view.
    from sms_tools.view.frames import TroubleError
    from sms_tools.view.sink import Sink

    recording = Path(directory) / RECORDING
    if choice.kind == "save":
        recording.parent.mkdir(parents=True, exist_ok=True)
    sink = Sink(choice, recording, system.title or system.name)
    try:
        place = _draw(sink, build_model(system), exaggeration)
    except TroubleError as error:
        raise InputError("--rerun", "", str(error), EXPECTED) from None
    print(f"view: {place}", file=sys.stderr)
    if sink.serving:
        with Interruption() as interruption:
            print("the view stays until Ctrl-C", file=sys.stderr)
            while sink.serving and not interruption.requested:
                interruption.sleep(1.0)
        sink.end_server()
    sink.close()
    return place


def _draw(sink: Sink, model: Model, exaggeration: float) -> str:
    """Everything at t = 0; where it is to be seen."""
    import rerun as rr

    from sms_tools.view import style
    from sms_tools.view.arm_log import ArmLog

    scene = Scene(model, exaggeration)
    x = np.zeros((1, model.layout.n_x))
    if "eta" in model.layout.position_names:
        x[0, model.layout.position_names.index("eta")] = 1.0
    place = sink.open(_layout(scene, x))
    ArmLog(sink.stream, scene).write(np.zeros(1), x, np.full((1, len(model.system.links)), np.nan), {}, style.LINK)
    names, origins, rotations = _frames(model, x)
    length = AXIS_LENGTH * scene.reach
    for axis, color in enumerate(COLORS):
        arrows = rr.Arrows3D(
            origins=origins,
            vectors=length * rotations[:, :, axis],
            colors=[color] * len(origins),
            radii=AXIS_RADIUS * scene.reach,
            labels=names if axis == 0 else None,
            show_labels=axis == 0,
        )
        sink.stream.log(f"{FRAMES}/{'xyz'[axis]}", arrows, static=True)
    table = channel_table(model.system)
    drawing = scene.draw(x)
    at, labels = [], []
    for row in table:
        kind, _, number = row.place.partition("_")
        if kind == "joint":
            at.append(drawing.joints[0, int(number) - 1])
            labels.append(", ".join(row.channels))
        elif kind == "base":
            at.append(drawing.S[0])
            labels.append(f"S: {', '.join(name for name in row.channels if name.startswith(('r_S', 'eps', 'theta')))}")
    for (link, marker), point in zip(scene.markers, drawing.markers[0], strict=True):
        own = f"link_{link}.marker_{marker}."
        fields = [name.removeprefix(own) for name in channels(model.system) if name.startswith(own)]
        at.append(point)
        labels.append(f"{own}{{{','.join(fields)}}}")
    points = rr.Points3D(np.array(at), labels=labels, show_labels=True, radii=0.0, colors=[style.LINK] * len(at))
    sink.stream.log(CHANNELS, points, static=True)
    text = "\n".join(
        ["| where | channels |", "|---|---|", *(f"| {r.place} | {', '.join(r.channels)} |" for r in table)]
    )
    sink.stream.log(TEXT, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
    sink.flush()
    return place


def _layout(scene: Scene, x: Array) -> rrb.Blueprint:
    import rerun.blueprint as rrb

    from sms_tools.view.blueprint import arm_view

    words = rrb.TextDocumentView(origin=TEXT, name="Channels")
    return rrb.Blueprint(
        rrb.Horizontal(arm_view(scene, scene.draw(x)), words, column_shares=[3, 1]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed"),
        auto_views=False,
    )


def _frames(model: Model, x: Array) -> tuple[list[str], Array, Array]:
    """Names, origins (F, 3) and rotations (F, 3, 3) of {0}, of every {i} and of the tip."""
    configuration = model.chain.configure(x)
    called = mounts(model.system)
    chosen = {"{0}": 0}
    for i, mount in enumerate(called, start=1):
        chosen[f"{{{i}}} {mount.name}".strip()] = 2 * i
    chosen["tip"] = model.chain.tip_frame
    frames = [configuration.frames[k] for k in chosen.values()]
    return list(chosen), np.stack([f.origin[0] for f in frames]), np.stack([f.rotation[0] for f in frames])
