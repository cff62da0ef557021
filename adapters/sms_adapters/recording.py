"""A recording as a source of blocks: the raw items through the same ticks as when they arrived."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from sms_adapters.checkpoint import read_checkpoint
from sms_adapters.clock_lanes import merger
from sms_adapters.clock_merge import TICK, TICK_MICROSECONDS
from sms_adapters.raw import CanFrames, Raw
from sms_adapters.session_log import CHECKPOINT, RULES, SYSTEM, RecordedItems, from_microseconds, read_header
from sms_online.checkpoint import SOURCE, Checkpoint
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.stream import Block


def tick_time(number: int) -> float:
    """Time of a tick, s."""
    return from_microseconds(number * TICK_MICROSECONDS)


def split(items: Sequence[Raw], time: float) -> tuple[list[Raw], list[Raw]]:
    """Items that arrived before `time`, s, and the others; items in order of arrival."""
    for k, item in enumerate(items):
        if isinstance(item, CanFrames):
            count = int(np.searchsorted(item.arrival, time, side="left"))
            if count < len(item):
                early = [item[:count]] if count else []
                return [*items[:k], *early], [item[count:], *items[k + 1 :]]
        elif item.arrival >= time:
            return list(items[:k]), list(items[k:])
    return list(items), []


def resumed_from(path: Path) -> Checkpoint | None:
    """The state that a recorded session resumed from, None where it began anew or the path is no recording."""
    checkpoint = path / CHECKPOINT
    return read_checkpoint(checkpoint) if checkpoint.is_file() else None


class Recording:
    """What a live session recorded, as the session's own blocks: a `Source`.

    directory: of session.toml. system: as the session had it; its sources are those of the recording. system_directory:
    where its file lies. on_bytes: called with the bytes of the recording consumed so far. origin: the session's start,
    s. Raises InputError where the directory is no recording, or of other sources.
    """

    def __init__(
        self,
        directory: Path,
        system: System,
        system_directory: Path | None = None,
        on_bytes: Callable[[int], None] | None = None,
    ) -> None:
        self._directory, self._on_bytes = directory, on_bytes
        self._header, self._ending = read_header(directory)
        self.origin = self._header.start
        self._system, self._system_directory = system, system_directory
        names = [source.name for source in system.devices]
        if set(names) != set(self._header.sources):
            found = ", ".join(self._header.sources) or "none"
            expected = f"those of the system: {', '.join(names) or 'none'}; --system {directory / SYSTEM} has its own"
            raise InputError(str(directory), "sources", found, expected)
        self._merger = merger(system, system_directory, self._header.start)
        self._items: list[RecordedItems] = []  # of the current iteration

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels of all sources, in the order of the system file."""
        return self._merger.channels

    @property
    def warnings(self) -> list[str]:
        """What was wrong with the devices, and with the recording."""
        cut = [
            f"{items.path.name}: the last line is cut (no newline at its end) and left out"
            for items in self._items
            if items.cut
        ]
        found = self._merger.warnings + cut
        if self._header.rules != RULES:
            found.append(f"{self._directory.name}: recorded by another version, results differ a little from its own")
        if self._ending is None:
            found.append(f"{self._directory.name}: the session was killed; this is what was on disk")
            return found
        return found + list(self._ending["warnings"])

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks from the beginning."""
        consumed: dict[Path, int] = {}

        def note(path: Path, count: int) -> None:
            consumed[path] = count
            if self._on_bytes is not None:
                self._on_bytes(sum(consumed.values()))

        self._items = [
            RecordedItems(self._directory, source.name, self._header.sources[source.name], self._header.epoch, note)
            for source in self._system.devices
        ]
        self._merger = ours = merger(self._system, self._system_directory, self._header.start)
        if (resumed := resumed_from(self._directory)) is not None:
            resumed.put_beside(SOURCE, ours)
        recorded = [iter(items) for items in self._items]
        waiting: list[list[Raw]] = [[] for _ in recorded]
        number = 0
        last = 0 if self._ending is None else round(self._ending["duration_s"] / TICK)
        while True:
            for k, items in enumerate(recorded):
                # One item beyond the tick shows that the tick is complete.
                while not split(waiting[k], tick_time(number + 1))[1] and (item := next(items, None)) is not None:
                    waiting[k].append(item)
            # The session went on after the last item, and counted the silence.
            if not any(waiting) and number >= last:
                break
            number += 1
            now = tick_time(number)
            due = []
            for k in range(len(waiting)):
                early, waiting[k] = split(waiting[k], now)
                due.append(early)
            block = ours.advance(now, due)
            if block is not None:
                yield block
        block = ours.finish()
        if block is not None:
            yield block
