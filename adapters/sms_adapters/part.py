"""A part of a recorded session, whatever it is recorded in."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from sms_online.errors import InputError
from sms_online.stream import Block, Relayed, Source


class Part(Relayed):
    """The samples of a source with start <= t - origin < stop, s, with their own t: a `Source`.

    name: of the source, for messages. start, stop: None for all before or after. origin: None for the first sample's
    time. The source is read no further than to `stop`; InputError where nothing lies in between.
    """

    def __init__(
        self, source: Source, name: str, start: float | None, stop: float | None, origin: float | None = None
    ) -> None:
        super().__init__(source)
        self._name, self._origin = name, origin
        self._start, self._stop = -math.inf if start is None else start, math.inf if stop is None else stop

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks of the part."""
        origin, empty = self._origin, True
        for block in self.source:
            if not block.t.size:
                continue
            origin = float(block.t[0]) if origin is None else origin
            t = block.t - origin
            inside = slice(*np.searchsorted(t, (self._start, self._stop)))
            if t[inside].size:
                empty = False
                yield Block(block.t[inside], block.channels, block.values[inside])
            if t[-1] >= self._stop:
                break
        if empty:
            asked = f"from {max(self._start, 0.0):g} s" + (f" to {self._stop:g} s" if self._stop < math.inf else "")
            raise InputError(self._name, "", f"no samples {asked}", "a part of the session")
