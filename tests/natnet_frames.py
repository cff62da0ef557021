"""Frames as a motion capture sends them: the layout of NatNet 2.9, 3.1, 4.0 and 4.1, written anew.

Source: NaturalPoint, NatNet SDK, data types and bitstream syntax.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

FRAME = 7
OCCLUDED, POINT_CLOUD, MODEL = 1, 2, 4


class Body(NamedTuple):
    """Streaming ID, place, Euler parameters x, y, z, w, whether it is tracked."""

    asset: int
    place: tuple[float, float, float]
    turn: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    tracked: bool = True


class Mark(NamedTuple):
    """ID of the asset, number in it, place, bits of what is known of it."""

    asset: int
    number: int
    place: tuple[float, float, float]
    bits: int = POINT_CLOUD


def frame(
    number: int, time: float, bodies: Sequence[Body], marks: Sequence[Mark], version: tuple[int, int] = (3, 1)
) -> bytes:
    """A datagram with a frame."""
    body = b"".join(_body(each, version) for each in bodies)
    mark = b"".join(_mark(each, version) for each in marks)
    sets = b"all\0" + struct.pack("<I", len(marks)) + b"".join(struct.pack("<3f", *each.place) for each in marks)
    loose = struct.pack("<3f", 9.0, 9.0, 9.0)
    groups = [(1, sets), (1, loose), (len(bodies), body), (0, b"")]  # the last: skeletons
    groups += [(0, b"")] * (version >= (4, 1))  # assets
    groups += [(len(marks), mark), (0, b"")]  # and force plates
    groups += [(0, b"")] * (version >= (2, 11))  # devices
    contents = struct.pack("<I", number) + b"".join(_group(count, data, version) for count, data in groups)
    contents += struct.pack("<IId", 0, 0, time)
    if version >= (3, 0):
        contents += struct.pack("<3Q", 10**12, 10**12 + 1, 10**12 + 2)
    if version >= (4, 1):
        contents += struct.pack("<2I", 1, 2)
    return message(FRAME, contents + struct.pack("<HI", 0, 0))


def message(kind: int, contents: bytes) -> bytes:
    """A datagram with a message of any kind."""
    return struct.pack("<HH", kind, len(contents)) + contents


def _group(count: int, data: bytes, version: tuple[int, int]) -> bytes:
    size = struct.pack("<I", len(data)) if version >= (4, 1) else b""
    return struct.pack("<I", count) + size + data


def _body(body: Body, version: tuple[int, int]) -> bytes:
    markers = struct.pack("<I", 0) if version < (3, 0) else b""
    return struct.pack("<I7f", body.asset, *body.place, *body.turn) + markers + struct.pack("<fH", 1e-4, body.tracked)


def _mark(mark: Mark, version: tuple[int, int]) -> bytes:
    residual = struct.pack("<f", 1e-4) if version >= (3, 0) else b""
    return struct.pack("<I4fH", mark.asset << 16 | mark.number, *mark.place, 0.014, mark.bits) + residual
