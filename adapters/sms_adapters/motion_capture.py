"""Files of motion captures, C3D and the CSV exports of Motive and Nexus, as a capture of a system's points.

Source: The C3D File Format, c3d.org (by ezc3d); OptiTrack, Motive: data export, CSV; Vicon Nexus: ASCII export.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sms_adapters.extras import installed
from sms_adapters.mcap_capture import capture_writer
from sms_online.description.channels import point_channels
from sms_online.description.explain import hint, nearest
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.stream import Array, Block

METRES = {"m": 1.0, "meters": 1.0, "cm": 0.01, "centimeters": 0.01, "mm": 1e-3, "millimeters": 1e-3}


@dataclass(frozen=True)
class Tracks:
    """Markers by their names: t (B,), s, and positions (B, M, 3), m, in the file's axes, NaN where one is not seen."""

    t: Array
    names: tuple[str, ...]
    positions: Array


def import_points(source: Path, system: System, capture: Path) -> tuple[int, list[str]]:
    """Write the capture of the points of a system's markers; number of samples, and what was left out.

    A marker of the file is that of the system with the same `name`; the part before its last colon, the subject, may
    be left out. Raises InputError where the file is none of a motion capture or holds none of the system's markers.
    """
    suffix = source.suffix.lower()
    if suffix not in READERS:
        raise InputError(str(source), "", f"a file {suffix!r}", f"a motion capture: {', '.join(READERS)}")
    tracks = READERS[suffix](source)
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
    with capture_writer(capture, tuple(channels)) as writer:
        writer.write(Block(tracks.t, tuple(channels), np.concatenate(columns, axis=1)))
    left = [name for k, name in enumerate(tracks.names) if k not in used]
    return tracks.t.size, [f"markers left out: {', '.join(left)}"] if left else []


def read_c3d(source: Path) -> Tracks:
    """Points of a C3D file; InputError where it is none."""
    ezc3d = installed("ezc3d", str(source))
    try:
        data = ezc3d.c3d(str(source))
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(str(source), "", " ".join(str(error).split()), "a C3D file") from None
    point = data["parameters"]["POINT"]
    scale = _scale(source, str(point["UNITS"]["value"][0]))
    positions = np.asarray(data["data"]["points"], dtype=np.float64)[:3].transpose(2, 1, 0) * scale
    # A negative residual marks a point that was not seen.
    residuals = np.asarray(data["data"]["meta_points"]["residuals"], dtype=np.float64)[0].T
    positions[residuals < 0.0] = np.nan
    t = np.arange(len(positions)) / float(point["RATE"]["value"][0])
    return Tracks(t, tuple(map(str, point["LABELS"]["value"])), positions)


def read_csv(source: Path) -> Tracks:
    """Points of an export of Motive or Nexus; InputError where it is neither."""
    try:
        with source.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(str(source), "", str(error), "an export of Motive or Nexus (.csv)") from None
    first = rows[0][0].strip() if rows and rows[0] else ""
    if first == "Format Version":
        return _motive(source, rows)
    if first == "Trajectories":
        return _vicon(source, rows)
    raise InputError(str(source), "line 1", repr(first), "'Format Version' (Motive) or 'Trajectories' (Nexus)")


def _motive(source: Path, rows: list[list[str]]) -> Tracks:
    heads = {row[1].strip(): row for row in rows[1:8] if len(row) > 1}
    top = next((k for k, row in enumerate(rows[:10]) if row[:1] == ["Frame"]), None)
    if top is None or not {"Type", "Name"} <= set(heads):
        raise InputError(str(source), "header", "no rows Type, Name and Frame", "those of a CSV export of Motive")
    begin = rows[0].index("Length Units") + 1 if "Length Units" in rows[0] else 0
    scale = _scale(source, rows[0][begin] if begin else "Meters")
    columns: dict[str, list[int]] = {}
    for k, (kind, name, axis) in enumerate(zip(heads["Type"], heads["Name"], rows[top], strict=False)):
        # Rigid bodies repeat their markers as the solver places them; measured ones are of type Marker.
        if kind == "Marker" and axis in ("X", "Y", "Z"):
            columns.setdefault(name, []).append(k)
    numbers = _numbers(source, rows, top + 1)
    return _tracks(source, numbers[:, 1], columns, numbers * scale)


def _vicon(source: Path, rows: list[list[str]]) -> Tracks:
    try:
        rate, names = float(rows[1][0]), rows[2]
    except (IndexError, ValueError):
        raise InputError(str(source), "line 2", "no rate", "frames a second, after 'Trajectories'") from None
    end = next((k for k in range(5, len(rows)) if not any(rows[k])), len(rows))
    numbers = _numbers(source, rows[:end], 5)
    columns = {name.strip(): [k, k + 1, k + 2] for k, name in enumerate(names) if name.strip()}
    scale = _scale(source, rows[4][2] if len(rows[4]) > 2 else "")
    return _tracks(source, numbers[:, 0] / rate - numbers[0, 0] / rate, columns, numbers * scale)


def _tracks(source: Path, t: Array, columns: dict[str, list[int]], numbers: Array) -> Tracks:
    whole = {name: own[:3] for name, own in columns.items() if len(own) >= 3 and own[2] < numbers.shape[1]}
    if not whole:
        raise InputError(str(source), "header", "no markers", "columns X, Y, Z of each marker")
    positions = np.stack([numbers[:, own] for own in whole.values()], axis=1)
    return Tracks(t, tuple(whole), positions)


def _numbers(source: Path, rows: list[list[str]], first: int) -> Array:
    """Rows from `first` on as numbers, NaN in empty cells; InputError where a cell is none."""
    body = [row for row in rows[first:] if any(row)]
    if not body:
        raise InputError(str(source), f"line {first + 1}", "no samples", "one row a frame")
    out = np.full((len(body), max(map(len, body))), np.nan)
    for k, row in enumerate(body):
        for column, cell in enumerate(row):
            if cell.strip():
                try:
                    out[k, column] = float(cell)
                except ValueError:
                    place = f"line {first + k + 1}"
                    raise InputError(str(source), place, repr(cell), "a number or an empty cell") from None
    return out


def _scale(source: Path, unit: str) -> float:
    if unit.strip().lower() not in METRES:
        raise InputError(str(source), "unit", repr(unit), f"one of {', '.join(METRES)}")
    return METRES[unit.strip().lower()]


READERS: dict[str, Callable[[Path], Tracks]] = {".c3d": read_c3d, ".csv": read_csv}
