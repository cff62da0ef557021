"""Values in groups by a key, and channels by the rows that they have samples in."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from typing import TypeVar

import numpy as np

from sms_online.stream import Array, Indices

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


def grouped(pairs: Iterable[tuple[Key, Value]]) -> dict[Key, list[Value]]:
    """Values of each key, from pairs of a key and a value; keys in the order in which they come first."""
    out: dict[Key, list[Value]] = {}
    for key, value in pairs:
        out.setdefault(key, []).append(value)
    return out


def sampled_together(values: Array, labels: Iterable[Hashable]) -> list[tuple[Indices, Indices]]:
    """Columns of values (B, C), NaN where there is no sample, that have samples in the same rows, and these rows.

    labels: of each column; those of different labels are kept apart.
    """
    present = ~np.isnan(values)
    bits = np.packbits(present, axis=0).T
    members = grouped(((own.tobytes(), label), k) for k, (own, label) in enumerate(zip(bits, labels, strict=True)))
    return [(np.array(columns), np.flatnonzero(present[:, columns[0]])) for columns in members.values()]
