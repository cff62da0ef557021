"""One topic of a bag: the stamp and the numbers of each message, collected into arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_adapters.log_lanes import Lane
from sms_adapters.log_paths import NANOSECONDS, MessagePath, fields_of, nanoseconds
from sms_online.description.explain import nearest, quoted
from sms_online.description.sources import BagSource
from sms_online.errors import InputError
from sms_online.stream import Array

# Stamps follow the times at which their messages were recorded up to this, s; one that does not is wrong.
PLAUSIBLE = 10.0
RECORDED = "recorded"
_SECOND = NANOSECONDS["s"]


class Topic:
    """Collects what a lane needs of each message. Raises InputError for a path that leads to no number or time."""

    def __init__(self, lane: Lane) -> None:
        assert isinstance(lane.source, BagSource)
        self._lane = lane
        self._unit = lane.source.stamp_unit
        self._stamp = None if lane.source.stamp == RECORDED else MessagePath(lane.source.stamp)
        self._paths = [MessagePath(key) for key in lane.keys]
        self._offset: float | None = None  # from the time of recording to the stamp, of most of the first messages, s
        self._seen = False
        self._clear()

    def _clear(self) -> None:
        self._stamps: list[int | float] = []
        self._recorded: list[int] = []
        self._numbers: list[list[float]] = []

    def add(self, recorded: int, message: Any) -> None:
        """Take a message and the time of its recording, ns."""
        if not self._seen:
            self._seen = True
            self._check(message)
        try:
            stamp = None if self._stamp is None else self._stamp(message)
            self._numbers.append([path.number(message) for path in self._paths])
            self._stamps.append(recorded if stamp is None else nanoseconds(stamp, self._unit))
        except (TypeError, ValueError, OverflowError) as error:
            expected = "numbers, and a time as the stamp"
            raise InputError(str(self._lane.path), self._lane.place, str(error), expected) from None
        self._recorded.append(recorded)

    def take(self) -> tuple[NDArray[Any], str, Array]:
        """Stamps, their unit and numbers of the messages since the last time."""
        whole = all(isinstance(stamp, int) for stamp in self._stamps)
        stamps = np.array(self._stamps if whole else [s / _SECOND if isinstance(s, int) else s for s in self._stamps])
        recorded, numbers = np.array(self._recorded, dtype=np.int64), np.array(self._numbers)
        self._clear()
        if not stamps.size:
            return stamps, "s", numbers
        if self._offset is None and stamps.size > 1 and (stamps == stamps[0]).all():
            found, expected = "the same stamp in every message", f'stamp = "{RECORDED}" in its source, or another path'
            raise InputError(str(self._lane.path), self._lane.place, found, expected)
        offsets = (stamps - recorded) / _SECOND if whole else stamps - recorded / _SECOND
        if self._offset is None:
            # The first message of all may have been sent before its clock was there.
            self._offset = float(np.median(offsets[np.isfinite(offsets)])) if np.isfinite(offsets).any() else 0.0
        plausible = np.abs(offsets - self._offset) <= PLAUSIBLE
        self._lane.implausible += int(np.count_nonzero(~plausible))
        return stamps[plausible], "ns" if whole else "s", numbers[plausible]

    def _check(self, message: Any) -> None:
        """InputError where a message of a fixed kind has no such field."""
        if isinstance(message, Mapping):
            return
        there = fields_of(message)
        for key in self._lane.keys:
            field = key.partition(".")[0].partition("[")[0]
            if field not in there:
                expected = quoted(there, nearest(field, there))
                raise InputError(str(self._lane.path), f"{self._lane.place}.{key}", f"no field {field!r}", expected)
