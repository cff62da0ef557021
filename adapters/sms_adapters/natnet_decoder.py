"""Frames of OptiTrack's protocol NatNet to samples of rigid bodies and markers.

Source: NaturalPoint, NatNet SDK: data types and bitstream syntax, versions 2 to 4.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from sms_adapters.conversion import Conversions, FrameCounter
from sms_adapters.extras import installed
from sms_adapters.raw import DecodedSamples, Raw, SerialChunk
from sms_online.description.sources import NatnetSource

# Identifier of a frame of data, and the bytes of every message before its contents: identifier and length.
FRAME, HEAD = 7, 4
# Most bytes that a frame has behind what is read of it.
REST = 24
# Frame numbers are words of 32 bits.
MODULUS = 1 << 32
PARTS = ("x", "y", "z", "qx", "qy", "qz", "qw", "yaw")
YAW = "yaw"

# Of a rigid body its streaming ID and 0, of a marker that of its asset and its number.
Target = tuple[int, int]


class NatnetDecoder:
    """Decodes frames of NatNet: a `Decoder`.

    t_device is the frame's time stamp, s since the motion capture was started. A body that is not tracked, and a marker
    that is hidden or filled in by a model, has no position (counted as hidden).
    """

    def __init__(self, source: NatnetSource) -> None:
        """Raises InputError where the package natnet is missing."""
        natnet = installed("natnet", "", f"source {source.name}", "natnet")
        self._read = natnet.DataFrame.read_from_buffer
        self._buffer = bounded(installed("natnet.packet_buffer", "").PacketBuffer)
        self._version = natnet.Version.from_str(source.version)
        self.channels = tuple(signal.channel for signal in source.signals.values())
        self.counters = dict.fromkeys(("bad_frame", *FrameCounter.KINDS, "hidden", "non_finite", "out_of_range"), 0)
        self._counter = FrameCounter(MODULUS, self.counters)
        columns: dict[Target, list[int]] = {}
        self._parts: list[int] = []
        signals = []
        for column, (key, signal) in enumerate(source.signals.items()):
            asset, *marker, part = key.split(".")
            columns.setdefault((int(asset), int(*marker)), []).append(column)
            self._parts.append(PARTS.index(part))
            turns = part == YAW and signal.wrap is None
            signals.append(signal.model_copy(update={"wrap": 2.0 * math.pi}) if turns else signal)
        self._columns = columns
        self._conversions = {
            target: Conversions([signals[column] for column in mine], self.counters) for target, mine in columns.items()
        }
        self.turns = {channel: turns for each in self._conversions.values() for channel, turns in each.turns.items()}

    def push(self, *items: Raw) -> DecodedSamples:
        """The samples of some datagrams, (M, C) values with NaN where nothing was seen."""
        arrival, frames = [], []
        for item in items:
            if not isinstance(item, SerialChunk):
                raise TypeError(f"{type(item).__name__} pushed into a decoder of datagrams")
            frame = self._frame(item.data)
            if frame is not None:
                arrival.append(item.arrival)
                frames.append(frame)
        counts = np.array([frame.prefix.frame_number for frame in frames], dtype=np.int64)
        used = np.flatnonzero(self._counter.admit(counts)).tolist()
        values = np.full((len(used), len(self.channels)), np.nan)
        seen = [{target: numbers for target, numbers in positions(frames[k]) if target in self._columns} for k in used]
        for target, columns in self._columns.items():
            rows = [row for row, found in enumerate(seen) if target in found]
            self.counters["hidden"] += len(used) - len(rows)
            if rows:
                parts = [self._parts[column] for column in columns]
                numbers = np.array([seen[row][target] for row in rows])[:, parts]
                values[np.ix_(rows, columns)] = self._conversions[target](numbers)
        t = np.array([[arrival[k], frames[k].suffix.timestamp] for k in used]).reshape(-1, 2)
        # A frame in which nothing was seen is no sample.
        some = ~np.isnan(values).all(axis=1)
        return DecodedSamples(t[some, 0], t[some, 1], values[some])

    def _frame(self, data: bytes) -> Any:
        """The frame in a datagram; None for another message, and for one that is broken, which is counted."""
        if data[:2] != FRAME.to_bytes(2, "little"):
            self.counters["bad_frame"] += len(data) < HEAD
            return None
        buffer = self._buffer(data)
        buffer.pointer = HEAD
        try:
            if len(data) - HEAD != int.from_bytes(data[2:HEAD], "little"):
                raise ValueError("cut")
            frame = self._read(buffer, self._version)
            # Read as another version, the numbers are those of other bytes.
            if not math.isfinite(frame.suffix.timestamp) or len(data) - buffer.pointer > REST:
                raise ValueError("another version")
        except (struct.error, ValueError):
            self.counters["bad_frame"] += 1
            return None
        return frame


def bounded(buffer: Any) -> Any:
    """natnet's class of buffers, without its allocation of what a damaged length asks for."""

    class Bounded(buffer):  # type: ignore[misc]
        def read_float32_array(self, count: int) -> tuple[float, ...]:
            if 4 * count > len(self.data) - self.pointer:
                raise ValueError("more numbers than bytes")
            return tuple(super().read_float32_array(count))

    return Bounded


def positions(frame: Any) -> Iterator[tuple[Target, tuple[float, ...]]]:
    """What a frame's cameras saw: numbers of PARTS for a rigid body, x, y and z of a marker."""
    for body in frame.rigid_bodies:
        # Before version 2.6 nothing says whether it is tracked.
        if body.tracking_valid is not False:
            *_, z, w = body.rot
            yield (body.id_num, 0), (*body.pos, *body.rot, 2.0 * math.atan2(z, w))
    for marker in frame.labeled_markers or ():
        seen = marker.param is None or not (marker.occluded or (marker.model_solved and not marker.point_cloud_solved))
        if seen:
            yield (marker.model_id, marker.marker_id), marker.pos
