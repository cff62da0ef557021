"""A table or a bag as a source of blocks: lanes of what was sampled together, merged in order of time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from sms_adapters.capture import BLOCK
from sms_adapters.log_bags import Bag, is_bag, open_bag
from sms_adapters.log_lanes import Lane, Origin
from sms_adapters.log_merge import LogMerge
from sms_adapters.log_tables import ARRAY_ENDINGS, PARQUET_ENDINGS, ParquetTable, Table
from sms_adapters.log_topics import Topic
from sms_online.description.explain import hint, nearest
from sms_online.description.schema import System
from sms_online.description.sources import BagSource, LogSignal, TableSource
from sms_online.errors import InputError
from sms_online.grouping import grouped
from sms_online.stream import Array, Block

# Messages that are turned into arrays at once.
MESSAGES = 8192
# A topic is waited for so long after the newest stamp of all, s: longer than transport delays messages.
PATIENCE = 2.0
_SHOWN = 8

# Lane, stamps, their unit, and numbers.
Samples = tuple[int, NDArray[Any], str, Array]


class LogReader:
    """A table or bag as blocks in order of time; each iteration starts from its beginning.

    What its columns or topics mean is said by the system's sources of kind `table` or `bag`. Stamps that are whole
    numbers or dates count from the first one. on_bytes: see `open_table` and `open_bag`. What is skipped is counted in
    `warnings`.
    Raises InputError, on construction for a file that is not there, a system without such a source, a unit that is none
    and a topic that the bag does not hold; while iterating for what cannot be read, a column or path that is not there,
    stamps of a table that go back, and a channel without any sample.
    """

    def __init__(
        self,
        path: Path,
        system: System,
        on_bytes: Callable[[int], None] | None = None,
    ) -> None:
        self._path = path
        self._system = system
        self._on_bytes = on_bytes
        self._bag = open_bag(path, on_bytes) if is_bag(path) else None
        self._tables: list[Table] = []  # of each lane of a table
        self._topics: list[str] = []  # of each lane of a bag
        self._lanes = self._new_lanes()
        self._merge = LogMerge([len(lane.keys) for lane in self._lanes], PATIENCE)

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels of the sources, in the order of the system file, those of a topic together."""
        return tuple(channel for lane in self._lanes for channel in lane.channels)

    @property
    def warnings(self) -> list[str]:
        """What the current iteration has skipped so far."""
        found = [warning for lane in self._lanes for warning in lane.warnings]
        for lane, late in zip(self._lanes, self._merge.late, strict=True):
            if late:
                why = f"their stamps are more than {PATIENCE:g} s behind those of other topics"
                found.append(f"{self._path.name}, {lane.place}: {late} samples skipped, {why}")
        # Of one file all tables leave out the same.
        found += [warning for table in self._tables[:1] for warning in table.warnings]
        return found + ([self._bag.cut] if self._bag is not None and self._bag.cut else [])

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks from the file's beginning."""
        self._lanes = self._new_lanes()
        self._merge = LogMerge([len(lane.keys) for lane in self._lanes], math.inf if self._bag is None else PATIENCE)
        channels = self.channels
        for t, values in self._merged():
            yield from Block(t, channels, values).pieces(BLOCK)
        for lane in self._lanes:
            lane.check()

    def _merged(self) -> Iterator[tuple[Array, Array]]:
        """Times and values of all lanes, as they come to be in order."""
        origin = Origin()
        for pieces in self._of_tables() if self._bag is None else self._of_bag(self._bag):
            # All that was read at once, or the first topics would wait in vain for the others.
            for k, stamps, unit, numbers in pieces:
                if stamps.size:
                    self._merge.add(k, *self._lanes[k].rows(origin, stamps, unit, numbers))
            yield self._merge.take()
        yield self._merge.take(final=True)

    def _of_tables(self) -> Iterator[list[Samples]]:
        """Chunks of the tables, always of the one that is furthest behind."""
        self._tables = [open_table(self._path, None if k else self._on_bytes) for k in range(len(self._lanes))]
        readers = {}
        for k, (lane, table) in enumerate(zip(self._lanes, self._tables, strict=True)):
            assert isinstance(lane.source, TableSource)
            readers[k] = table.chunks(lane.source.stamp, lane.keys)
        while readers:
            k = min(readers, key=lambda each: self._merge.newest[each])
            chunk = next(readers[k], None)
            if chunk is None:
                del readers[k]
                self._merge.newest[k] = math.inf
            else:
                yield [(k, chunk[0], self._lanes[k].source.stamp_unit, chunk[1])]

    def _of_bag(self, bag: Bag) -> Iterator[list[Samples]]:
        """Numbers in the messages of each lane, some thousand messages at a time."""
        topics = [Topic(lane) for lane in self._lanes]
        lanes = grouped(zip(self._topics, topics, strict=True))
        for number, (name, recorded, message) in enumerate(bag.messages(tuple(lanes)), start=1):
            for topic in lanes[name]:
                topic.add(recorded, message)
            if number % MESSAGES == 0:
                yield [(k, *topic.take()) for k, topic in enumerate(topics)]
        yield [(k, *topic.take()) for k, topic in enumerate(topics)]

    def _new_lanes(self) -> list[Lane]:
        kind = TableSource if self._bag is None else BagSource
        sources = [source for source in self._system.sources if isinstance(source, kind)]
        if not sources:
            name = kind.model_fields["kind"].annotation.__args__[0]  # type: ignore[union-attr]
            expected = f"a [[source]] of kind {name!r} in the system {self._system.name!r}, which says what they mean"
            raise InputError(str(self._path), "", "columns" if self._bag is None else "topics", expected)
        if self._bag is None:
            return [Lane(self._path, self._system, each, f"source {each.name}", each.signals) for each in sources]
        there = self._bag.topics()
        lanes, self._topics = [], []
        for source in sources:
            signals: dict[str, dict[str, LogSignal]] = {}
            for key, signal in source.signals.items():
                topic, _, path = key.partition(".")
                signals.setdefault(topic, {})[path] = signal
            for topic, of_topic in signals.items():
                if topic not in there:
                    listed = ", ".join([*there[:_SHOWN], "…"] if len(there) > _SHOWN else there) or "none"
                    expected = f"one of its topics: {listed}{hint(nearest(topic, there))}"
                    raise InputError(str(self._path), "", f"no topic {topic!r}", expected)
                lanes.append(Lane(self._path, self._system, source, f"topic {topic}", of_topic))
                self._topics.append(topic)
        return lanes


def open_table(path: Path, on_bytes: Callable[[int], None] | None = None) -> Table:
    """The table in a file, by the ending of its name; InputError where there is no such file.

    on_bytes: called with the bytes consumed so far; where a format does not say, with the share of its rows.
    """
    if not path.is_file():
        raise InputError(str(path), "", "no such file", "a readable file")
    if path.suffix in PARQUET_ENDINGS:
        return ParquetTable(path, on_bytes)
    # Each of the others costs an import.
    if path.suffix in ARRAY_ENDINGS:
        from sms_adapters.log_arrays import ArrayTable

        return ArrayTable(path, on_bytes)
    from sms_adapters.log_csv import CsvTable

    return CsvTable(path, on_bytes)
