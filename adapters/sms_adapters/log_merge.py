"""Rows of several lanes of a log, each in order of time, as rows of all of them in order of time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sms_online.stream import Array


class LogMerge:
    """Merges lanes: rows that were sampled together, each of them in order of time.

    widths: columns of each lane. patience: a lane is waited for so long after the newest row of all, s; what comes
    after that is dropped and counted in `late`. Rows of the same instant become one. newest: time of each lane's last
    row, infinite where it has ended.
    """

    def __init__(self, widths: Sequence[int], patience: float) -> None:
        self.late = [0 for _ in widths]
        self.newest = [-math.inf for _ in widths]
        self._patience = patience
        self._columns = np.cumsum([0, *widths])
        self._given = -math.inf
        self._waiting: list[list[tuple[Array, Array]]] = [[] for _ in widths]

    def add(self, lane: int, t: Array, values: Array) -> None:
        """Take rows of a lane: t (B,), s, increasing, later than all before; values (B, C)."""
        late = int(np.searchsorted(t, self._given, side="right"))
        self.late[lane] += late
        if t.size:
            self.newest[lane] = float(t[-1])
            self._waiting[lane].append((t[late:], values[late:]))

    def take(self, final: bool = False) -> tuple[Array, Array]:
        """The rows that are in order by now, or all: t (K,), increasing, and values (K, all columns)."""
        due = math.inf if final else min(self.newest)
        if math.isfinite(self._patience):
            due = max(due, max(self.newest) - self._patience)
        times: list[Array] = []
        lanes: list[Array] = []
        for lane, parts in enumerate(self._waiting):
            t = np.concatenate([np.empty(0), *(part for part, _ in parts)])
            values = np.concatenate(
                [np.empty((0, self._columns[lane + 1] - self._columns[lane])), *(v for _, v in parts)]
            )
            count = int(np.searchsorted(t, due, side="right"))
            times.append(t[:count])
            lanes.append(values[:count])
            self._waiting[lane] = [(t[count:], values[count:])]
        self._given = max(self._given, due)
        instants = np.unique(np.concatenate(times))
        rows = np.full((instants.size, int(self._columns[-1])), np.nan)
        for lane, (t, values) in enumerate(zip(times, lanes, strict=True)):
            rows[np.searchsorted(instants, t), self._columns[lane] : self._columns[lane + 1]] = values
        return instants, rows
