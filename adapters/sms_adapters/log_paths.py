"""Paths of numbers in messages: `position[2]`, `position[elbow]`, `pose.position.x`, in objects and in JSON alike."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

# A field's name, or what is in brackets after it.
_STEP = re.compile(r"\.?([^.\[\]]+)|\[([^\[\]]+)\]")
# Where messages such as JointState list what the entries of their other lists belong to.
_NAMES = "name"
NANOSECONDS = {"s": 1_000_000_000, "ms": 1_000_000, "µs": 1000, "us": 1000, "ns": 1}
# What a time is made of, in ROS 1, ROS 2 and Foxglove's JSON.
_SECONDS, _REST = ("sec", "secs"), ("nanosec", "nsec", "nsecs")


class MessagePath:
    """What lies at a path in a message; None where nothing does, TypeError where an entry of no list is asked for.

    An entry in brackets is counted from 0, or named: then it is the place of the name in the message's list `name`.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        found = _STEP.findall(path)
        self._steps = [name or (int(entry) if entry.isdecimal() else (entry,)) for name, entry in found]

    def __call__(self, message: Any) -> Any:
        value = message
        for step in self._steps:
            if isinstance(step, str):
                value = _field(value, step)
            else:
                index = step if isinstance(step, int) else _place_of(message, step[0])
                if value is not None and not isinstance(value, Sequence | np.ndarray):
                    raise TypeError(f"{self.path} is no entry of a list")
                if index is None or value is None or len(value) <= index:
                    return None
                value = value[index]
        return value

    def number(self, message: Any) -> float:
        """The number at the path, NaN where there is none; TypeError where it is no number."""
        value = self(message)
        if value is None:
            return np.nan
        if isinstance(value, str | list | Mapping):
            raise TypeError(f"{self.path} is no number")
        return float(value)


def nanoseconds(stamp: Any, unit: str) -> int | float:
    """A stamp of a message: whole ns where it is of whole numbers, else s. TypeError where it is no time."""
    if isinstance(stamp, float | np.floating):
        return float(stamp) / (NANOSECONDS["s"] // NANOSECONDS[unit])
    if isinstance(stamp, int | np.integer):
        return int(stamp) * NANOSECONDS[unit]
    parts = [[part for name in names if (part := _field(stamp, name)) is not None] for names in (_SECONDS, _REST)]
    if not all(parts):
        raise TypeError(f"a stamp that is a {type(stamp).__name__}")
    return int(parts[0][0]) * NANOSECONDS["s"] + int(parts[1][0])


def fields_of(message: Any) -> Sequence[str]:
    """Names of a message's fields."""
    return tuple(message) if isinstance(message, Mapping) else tuple(vars(message))


def _field(value: Any, name: str) -> Any:
    return value.get(name) if isinstance(value, Mapping) else getattr(value, name, None)


def _place_of(message: Any, name: str) -> int | None:
    names = _field(message, _NAMES)
    return None if names is None or name not in names else list(names).index(name)
