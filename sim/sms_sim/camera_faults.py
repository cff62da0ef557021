"""What goes wrong with markers on a real rig: some are not seen for an instant or for a while, two are mistaken."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from sms_online.description.channels import AXES
from sms_online.errors import InputError
from sms_online.grouping import grouped
from sms_online.stream import Block

GRAMMAR = (
    "missing@MARKERS:share=NUMBER, hidden@MARKERS:begin=SECONDS,over=SECONDS "
    "or swapped@MARKER+MARKER:begin=SECONDS,over=SECONDS, with markers such as link_1.marker_2 or link_1.*"
)
KEYS = {"missing": ("share",), "hidden": ("begin", "over"), "swapped": ("begin", "over")}


@dataclass(frozen=True)
class CameraFault:
    """A fault of a motion capture.

    kind: `missing`, a share of the samples at random; `hidden`, all of them for a while; `swapped`, two markers are
    taken for each other for a while. markers: shell patterns, of swapped ones two names. begin, over: s.
    """

    kind: str
    markers: tuple[str, ...]
    share: float = 0.0
    begin: float = 0.0
    over: float = 0.0

    def document(self) -> dict[str, Any]:
        """The entry of the truth beside a capture: no key without a meaning."""
        return {name: value for name, value in vars(self).items() if value}


def parse_fault(text: str) -> CameraFault:
    """A fault from a text such as "missing@link_1.*:share=0.1"; InputError where it is none."""
    what, _, options = text.partition(":")
    kind, _, markers = what.partition("@")
    numbers: dict[str, float] = {}
    for option in filter(None, options.split(",")):
        key, _, value = option.partition("=")
        try:
            numbers[key] = float(value)
        except ValueError:
            numbers[key] = math.nan
    names = tuple(filter(None, markers.split("+")))
    right = set(numbers) == set(KEYS.get(kind, ("no such kind",))) and len(names) == (2 if kind == "swapped" else 1)
    possible = all(math.isfinite(number) and number >= 0.0 for number in numbers.values())
    if not right or not possible or numbers.get("share", 0.0) > 1.0:
        raise InputError("--fault", text, "no fault of a motion capture", GRAMMAR)
    return CameraFault(kind, names, **numbers)


class CameraFaults:
    """Faults of the points among some channels. Blocks have to come in order: what is missing is drawn row by row."""

    def __init__(self, faults: Sequence[CameraFault], channels: tuple[str, ...], seed: int) -> None:
        """Raises InputError where no point of the channels is meant."""
        points = enumerate(channel.rpartition(".") for channel in channels)
        columns = grouped((marker, k) for k, (marker, _, axis) in points if axis in AXES)
        self._faults = []
        for fault in faults:
            for pattern in fault.markers:
                if not any(fnmatchcase(marker, pattern) for marker in columns):
                    known = ", ".join(columns) or "none: the system describes no sensor of points"
                    raise InputError(
                        "--fault", fault.kind, f"no marker {pattern!r}", f"markers of the capture, {known}"
                    )
            meant = [
                [columns[marker] for marker in columns if fnmatchcase(marker, pattern)] for pattern in fault.markers
            ]
            self._faults.append((fault, [own for each in meant for own in each]))
        self._random = np.random.default_rng([seed, 1])

    def __call__(self, block: Block) -> Block:
        """The block with what its faults leave of it."""
        values = block.values.copy()
        for fault, markers in self._faults:
            inside = (block.t >= fault.begin) & (block.t < fault.begin + fault.over)
            if fault.kind == "swapped":
                first, second = (np.ix_(np.flatnonzero(inside), np.array(own)) for own in markers)
                values[first], values[second] = values[second], values[first].copy()
            elif fault.kind == "hidden":
                for own in markers:
                    values[np.ix_(np.flatnonzero(inside), np.array(own))] = np.nan
            else:
                gone = self._random.random((len(values), len(markers))) < fault.share
                for own, rows in zip(markers, gone.T, strict=True):
                    values[np.ix_(np.flatnonzero(rows), np.array(own))] = np.nan
        return Block(block.t, block.channels, values)


def parsed_faults(faults: Sequence[str | CameraFault]) -> tuple[CameraFault, ...]:
    """Faults as texts or records; InputError where one is none."""
    if isinstance(faults, str):
        raise InputError("faults", "", repr(faults), f"a list of faults, [{faults!r}]")
    return tuple(parse_fault(fault) if isinstance(fault, str) else fault for fault in faults)
