"""Messages of bags: ROS 1 and ROS 2 by rosbags, MCAP with ROS 2 or JSON messages by its own library."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from sms_adapters.extras import installed
from sms_adapters.files import size_of
from sms_adapters.raw import one_line
from sms_online.errors import InputError

# Topic, time of its recording, ns, and the message.
Recorded = tuple[str, int, Any]
Decode = Callable[[bytes], Any]

MCAP, BAGS = ".mcap", (".bag", ".db3")
_MAGIC = 8  # bytes that an MCAP file begins and ends with
METADATA = "metadata.yaml"  # of the directory that is a ROS 2 bag
# After so many messages of a ROS bag it is said how far it is read.
OFTEN = 1000


def is_bag(path: Path) -> bool:
    """Whether a file or directory is named as a bag is."""
    return path.suffix in (MCAP, *BAGS) or (path / METADATA).is_file()


def open_bag(path: Path, on_bytes: Callable[[int], None] | None = None) -> Bag:
    """The bag at a path; InputError where there is none.

    on_bytes: called with the bytes consumed so far; of a ROS bag, with the share of its messages.
    """
    if not path.exists():
        raise InputError(str(path), "", "no such file", "a bag")
    parts = [path] if path.is_file() else list(path.glob(f"*{MCAP}"))
    if parts and all(part.suffix == MCAP for part in parts):
        # Parts of a long bag are numbered, _2 before _10.
        return McapBag(path, sorted(parts, key=lambda part: (len(part.name), part.name)), on_bytes)
    return RosBag(path, on_bytes)


class Bag:
    """Recorded messages; `topics` and `messages` begin anew each time. cut: what of its end is missing, if anything."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut = ""

    def topics(self) -> tuple[str, ...]:
        """Names of the topics."""
        raise NotImplementedError

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """Messages of some topics, in the order of the file; InputError where the file cannot be read."""
        raise NotImplementedError

    def _broken(self, error: Exception) -> InputError:
        return InputError(str(self.path), "", one_line(error), "a bag without damage")


class RosBag(Bag):
    """A ROS 1 bag (.bag), a ROS 2 bag (its directory), or one of its databases (.db3).

    Limitation: a ROS 1 bag's index is held in memory, 200 bytes a message.
    """

    def __init__(self, path: Path, on_bytes: Callable[[int], None] | None) -> None:
        super().__init__(path)
        self._on_bytes = on_bytes

    def _reader(self) -> Any:
        highlevel = installed("rosbags.highlevel", str(self.path))
        typesys = installed("rosbags.typesys", str(self.path))
        # Of standard messages, for older ROS 2 bags do not say what theirs are made of.
        return highlevel.AnyReader([self.path], default_typestore=typesys.get_typestore(typesys.Stores.LATEST))

    def topics(self) -> tuple[str, ...]:
        """See `Bag`."""
        try:
            with self._reader() as reader:
                return tuple(reader.topics)
        except InputError:
            raise
        # What rosbags raises of a damaged file is Python's as often as its own.
        except Exception as error:
            raise self._broken(error) from None

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """See `Bag`."""
        reader = self._reader()
        try:
            reader.open()
            connections = [connection for connection in reader.connections if connection.topic in topics]
            count, size = sum(connection.msgcount for connection in connections), size_of(self.path)
            for number, (connection, recorded, data) in enumerate(reader.messages(connections), start=1):
                if self._on_bytes is not None and number % OFTEN == 0:
                    self._on_bytes(size * number // count)
                yield connection.topic, recorded, reader.deserialize(data, connection.msgtype)
        except InputError:
            raise
        except Exception as error:
            raise self._broken(error) from None
        finally:
            if reader.stack is not None:
                reader.close()


class McapBag(Bag):
    """One or more MCAP files. One that was never closed is read as far as it goes."""

    def __init__(self, path: Path, parts: list[Path], on_bytes: Callable[[int], None] | None) -> None:
        super().__init__(path)
        self._parts = parts
        self._on_bytes = on_bytes
        self._mcap = installed("mcap.reader", str(path))

    def topics(self) -> tuple[str, ...]:
        """See `Bag`. Of a file without an end they are those of its messages."""
        found: dict[str, None] = {}
        for part in self._parts:
            with part.open("rb") as file:
                summary = self._summary(file) if _is_whole(file) else None
                if summary is not None and summary.channels:
                    found |= dict.fromkeys(channel.topic for channel in summary.channels.values())
                else:
                    found |= dict.fromkeys(channel.topic for _, channel, _ in self._records(file, None))
        return tuple(found)

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """See `Bag`."""
        decoders: dict[tuple[Path, int], Decode] = {}
        before = 0  # bytes of the parts that are read
        for part in self._parts:
            with part.open("rb") as file:
                for schema, channel, message in self._records(file, list(topics)):
                    key = (part, channel.id)
                    if key not in decoders:
                        decoders[key] = self._decoder(schema, channel)
                    if self._on_bytes is not None:
                        self._on_bytes(before + file.tell())
                    yield channel.topic, message.log_time, self._decoded(decoders[key], message.data)
            before += part.stat().st_size

    def _summary(self, file: BinaryIO) -> Any:
        # What a damaged file makes its library raise is Python's as often as its own, here and in `_records`.
        try:
            return self._mcap.make_reader(file).get_summary()
        except Exception as error:
            raise self._broken(error) from None

    def _decoded(self, decode: Decode, data: bytes) -> Any:
        # What a wrong message makes the decoders raise is Python's as often as their own.
        try:
            return decode(data)
        except Exception as error:
            raise self._broken(error) from None

    def _records(self, file: Any, topics: list[str] | None) -> Iterator[tuple[Any, Any, Any]]:
        """Schema, channel and message, as far as the file goes."""
        exceptions = installed("mcap.exceptions", str(self.path))
        whole = _is_whole(file)
        if not whole:
            self.cut = f"{Path(file.name).name}: its end is missing"
        try:
            # In the order of the file: the library's reader by index queues all chunks' messages in that order.
            yield from self._mcap.NonSeekingReader(file).iter_messages(topics, log_time_order=False)
        except Exception as error:
            # Its library names an end between records, and raises what Python does of one within a record.
            if whole or not isinstance(error, exceptions.EndOfFile | struct.error):
                raise self._broken(error) from None

    def _decoder(self, schema: Any, channel: Any) -> Decode:
        """How the messages of a channel are read; InputError for an encoding that is not."""
        if channel.message_encoding == "json":
            return json.loads
        encodings = (channel.message_encoding, "" if schema is None else schema.encoding)
        if encodings not in (("cdr", "ros2msg"), ("ros1", "ros1msg")):
            found = f"messages in {channel.message_encoding or 'no encoding'}, schema in {encodings[1] or 'none'}"
            raise InputError(str(self.path), f"topic {channel.topic}", found, "JSON, or ROS messages with their schema")
        typesys = installed("rosbags.typesys", str(self.path), f"topic {channel.topic}")
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/")
        store.register(typesys.get_types_from_msg(schema.data.decode("utf-8"), name))
        read = store.deserialize_cdr if channel.message_encoding == "cdr" else store.deserialize_ros1
        return lambda data: read(data, name)


def _is_whole(file: BinaryIO) -> bool:
    """Whether an MCAP file was closed: it then ends as it begins. The file is at its beginning afterwards."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - _MAGIC))
    end = file.read(_MAGIC)
    file.seek(0)
    whole = size >= 2 * _MAGIC and file.read(_MAGIC) == end
    file.seek(0)
    return whole
