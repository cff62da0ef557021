"""A motion capture as a capture of a system's points and base, alone or on the clock of the drives' recording."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sms_adapters.camera_clock import CameraClock, ClockFit, shift_between
from sms_adapters.log_merge import LogMerge
from sms_adapters.mcap_capture import capture_writer
from sms_adapters.motion_capture import Tracks, read_tracks
from sms_online.description.channels import point_channels
from sms_online.description.explain import hint, nearest
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.errors import InputError
from sms_online.model.layout import Layout
from sms_online.model.points import Points
from sms_online.pipeline.sensing import Sensing
from sms_online.stream import Array, Block, Source

# A shift explains the motion where it leaves less than this share of its variance: links bend.
MOST_LEFT = 0.1
# Shortest recording whose clock is compared, s.
SHORTEST = 1.0
# Instants that the arm is configured at in one call.
TOGETHER = 4096


def import_points(
    source: Path, system: System, capture: Path, drives: Source | None = None
) -> tuple[int, list[str], list[str]]:
    """Write the capture of the points of a system's markers and of its base.

    Number of samples, what was left out, and what was found of the clocks.

    A marker of the file is that of the system with the same `name`; the part before its last colon, the subject, may
    be left out. The base is the rigid body with the spacecraft's `name`. drives: what drives and encoders recorded
    meanwhile on a clock of their own; the capture then holds both, on that clock. Raises InputError where the file is
    none of a motion capture or holds none of the system's markers, and where the clocks cannot be compared.
    """
    tracks = read_tracks(source)
    seen, left = _seen(source, system, tracks)
    warnings = [f"markers left out: {', '.join(left)}"] if left else []
    found = []
    if drives is not None:
        seen, clock = _beside(str(source), system, seen, drives)
        warnings += drives.warnings
        found.append(clock)
    with capture_writer(capture, seen.channels) as writer:
        writer.write(seen)
    return seen.t.size, warnings, found


def _seen(source: Path, system: System, tracks: Tracks) -> tuple[Block, list[str]]:
    """What a file holds of a system's points and base, and the names of the markers that are none of them."""
    short = [name.rpartition(":")[2] for name in tracks.names]
    channels: list[str] = []
    columns: list[Array] = []
    used: set[int] = set()
    named = []
    for i, link in enumerate(system.links, start=1):
        axes = len(point_channels(system, i)) // max(1, len(link.points))
        for j, marker in enumerate(link.markers, start=1):
            named.append(marker.name)
            names = list(tracks.names) if marker.name in tracks.names else short
            if not marker.name or marker.name not in names:
                continue
            used.add(names.index(marker.name))
            channels += point_channels(system, i)[axes * (j - 1) : axes * j]
            columns.append(tracks.positions[:, names.index(marker.name), :axes])
    if not channels:
        found = f"markers {', '.join(tracks.names) or 'without names'}"
        wanted = ", ".join(filter(None, named)) or "none has a name"
        near = nearest(short[0], named) if short else None
        raise InputError(str(source), "", found, f"those of {system.name}: {wanted}{hint(near)}")
    for name, values in _base(source, system, tracks).items():
        channels.append(name)
        columns.append(values[:, None])
    left = [name for k, name in enumerate(tracks.names) if k not in used]
    return Block(tracks.t, tuple(channels), np.concatenate(columns, axis=1)), left


def _base(source: Path, system: System, tracks: Tracks) -> dict[str, Array]:
    """Channels of the base's pose, none where it is fixed or has no name."""
    if system.spacecraft is None or not system.spacecraft.name:
        return {}
    name = system.spacecraft.name
    if name not in tracks.bodies:
        found = f"rigid bodies {', '.join(tracks.bodies)}" if tracks.bodies else "no rigid body"
        expected = f"{name!r}, the name of [spacecraft], with its rotation as a quaternion"
        raise InputError(str(source), "", found, f"{expected}{hint(nearest(name, list(tracks.bodies)))}")
    position, turned = tracks.bodies[name]
    places = dict(zip(("r_S_x", "r_S_y", "r_S_z"), position.T, strict=True))
    if system.motion == "spatial":
        return places | dict(zip(("eps_x", "eps_y", "eps_z", "eta"), turned.T, strict=True))
    x, y, z, w = turned.T
    angle = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2))
    known = np.isfinite(angle)
    angle[known] = np.unwrap(angle[known])
    del places["r_S_z"]
    return places | {"theta_0": angle}


def _beside(place: str, system: System, seen: Block, drives: Source) -> tuple[Block, str]:
    """What the cameras saw and what the drives recorded, on the drives' clock, and a sentence about the clocks."""
    blocks = list(drives)
    if not blocks:
        raise InputError(place, "--beside", "no samples", "a recording of drives and encoders")
    t = np.concatenate([block.t for block in blocks])
    values = np.concatenate([block.values for block in blocks])
    # A reader may offer channels that its file has no sample of.
    held = np.isfinite(values).any(axis=0)
    recorded = Block(t, tuple(name for name, own in zip(drives.channels, held, strict=True) if own), values[:, held])
    twice = [name for name in seen.channels if name in recorded.channels]
    if twice:
        expected = "channels in one of both; leave them out of the recording"
        raise InputError(place, "--beside", f"{', '.join(twice)} in both", expected)
    clock = _clock(place, system, seen, recorded)
    merge = LogMerge((len(seen.channels), len(recorded.channels)), patience=np.inf)
    merge.add(0, clock.of_drives(seen.t), seen.values)
    merge.add(1, recorded.t, recorded.values)
    instants, rows = merge.take(final=True)
    sentence = f"t = 0 of {place} is {clock.offset:.6f} ± {clock.offset_std:.6f} s of the recording beside it"
    if clock.rate:
        faster = "slower" if clock.rate > 0.0 else "faster"
        ppm, std = 1e6 * abs(clock.rate), 1e6 * clock.rate_std
        sentence += f"; the cameras' clock is {ppm:.0f} ± {std:.0f} ppm {faster}"
    return Block(instants, (*seen.channels, *recorded.channels), rows), sentence


def _clock(place: str, system: System, seen: Block, recorded: Block) -> CameraClock:
    """The cameras' clock beside that of encoders, from the course of the points; InputError where they say none."""
    if min(np.ptp(seen.t), np.ptp(recorded.t)) < SHORTEST:
        longer = f"a motion of {SHORTEST:g} s or more in both"
        raise InputError(place, "--beside", "too short a recording to compare clocks", longer)
    model = build_model(system)
    layout, points = model.layout, Points(system, model.chain)
    sensing = Sensing(model, (*seen.channels, *recorded.channels), place)
    columns = [seen.channels.index(name) for name in points.names if name in seen.channels]
    shown = [points.names.index(seen.channels[column]) for column in columns]
    base = layout.position_names[: layout.n_base_positions]
    measured, given = seen.values[:, columns], {}
    if set(base) <= set(seen.channels):
        measured = _in_base(seen.values[:, [seen.channels.index(name) for name in base]], layout, measured)
        given = {name: float(name == "eta") for name in base}
    t, x = _undeformed(sensing, recorded, given)
    expected = np.concatenate([points(x[k : k + TOGETHER])[:, shown] for k in range(0, len(x), TOGETHER)])
    found = shift_between(seen.t, measured, t, expected)
    if found.left > MOST_LEFT:
        explained = f"markers whose motion the encoders explain to {100 * (1.0 - found.left):.0f} % at best"
        same = "the same motion: names of markers, axes with z up, signs and gears of encoders"
        raise InputError(place, "--beside", explained, same)
    if found.other is not None:
        several = f"a motion that repeats: t = 0 is {found.shift:.2f} or {found.other:.2f} s of the recording"
        raise InputError(place, "--beside", several, "one that does not, or whose beginning or end both hold")
    return ClockFit(model, sensing, seen, recorded).clock(found.shift)


def _in_base(pose: Array, layout: Layout, points: Array) -> Array:
    """Points (B, M axes) of inertial axes in those of a base of pose (B, n)."""
    axes = 2 if layout.planar else 3
    origin, turned = layout.base_pose(pose)
    apart = points.reshape(len(points), -1, axes) - origin[:, None, :axes]
    return np.asarray(apart @ turned[:, :axes, :axes]).reshape(points.shape)


def _undeformed(sensing: Sensing, recorded: Block, given: Mapping[str, float]) -> tuple[Array, Array]:
    """Instants (N,) of the encoder with most samples, and positions (N, n_x) of the arm without deflections.

    given: channels that are not recorded.
    """
    sampled = {}
    for name, own in zip(recorded.channels, recorded.values.T, strict=True):
        known = np.isfinite(own)
        sampled[name] = recorded.t[known], own[known]
    positions = set(sensing.model.layout.position_names)
    t = max((times for name, (times, _) in sampled.items() if name in positions), key=len)
    columns = [
        np.interp(t, *sampled[name]) if name in sampled else np.full(t.size, given.get(name, np.nan))
        for name in sensing.channels
    ]
    x = np.zeros((t.size, sensing.model.layout.n_x))
    x[:, : sensing.n_rigid] = sensing.rigid(np.stack(columns, axis=1))
    return t, x
