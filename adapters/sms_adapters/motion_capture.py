"""Files of motion captures, C3D and the CSV exports of Motive and Nexus, as markers and rigid bodies by their names.

Source: The C3D File Format, c3d.org (by ezc3d); OptiTrack, Motive: data export, CSV; Vicon Nexus: ASCII export.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sms_adapters.extras import installed
from sms_online.errors import InputError
from sms_online.stream import Array

METRES = {"m": 1.0, "meters": 1.0, "cm": 0.01, "centimeters": 0.01, "mm": 1e-3, "millimeters": 1e-3}


@dataclass(frozen=True)
class Tracks:
    """Markers and rigid bodies by their names, in the file's axes, NaN where one is not seen.

    t (B,): s. positions (B, M, 3): of the markers, m. bodies: names of the rigid bodies, to the positions (B, 3) of
    their origins, m, and their Euler parameters (B, 4), the scalar last, body to file.
    """

    t: Array
    names: tuple[str, ...]
    positions: Array
    bodies: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)


def read_tracks(source: Path) -> Tracks:
    """What a file of a motion capture holds; InputError where it is none."""
    suffix = source.suffix.lower()
    if suffix not in READERS:
        raise InputError(str(source), "", f"a file {suffix!r}", f"a motion capture: {', '.join(READERS)}")
    return READERS[suffix](source)


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
    bodies: dict[str, dict[tuple[str, str], int]] = {}
    heading = zip(heads["Type"], heads["Name"], rows[top - 1], rows[top], strict=False)
    for k, (kind, name, quantity, axis) in enumerate(heading):
        # Rigid bodies repeat their markers as the solver places them; measured ones are of type Marker.
        if kind == "Marker" and axis in ("X", "Y", "Z"):
            columns.setdefault(name, []).append(k)
        elif kind == "Rigid Body":
            bodies.setdefault(name, {})[quantity, axis] = k
    numbers = _numbers(source, rows, top + 1)
    poses = {}
    for name, own in bodies.items():
        places = [own["Position", axis] for axis in "XYZ" if ("Position", axis) in own]
        turns = [own["Rotation", axis] for axis in "XYZW" if ("Rotation", axis) in own]
        # Rotations exported as Euler angles have no W.
        if (len(places), len(turns)) == (3, 4):
            poses[name] = numbers[:, places] * scale, numbers[:, turns]
    return replace(_tracks(source, numbers[:, 1], columns, numbers * scale), bodies=poses)


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
