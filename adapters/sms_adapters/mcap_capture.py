"""Captures as MCAP with a JSON schema, which Foxglove and PlotJuggler open."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sms_adapters.capture import CaptureWriter
from sms_adapters.extras import installed
from sms_adapters.files import WholeFile
from sms_online.stream import Block

ENDING = ".mcap"
# One message a sample: t, s, and the values that it holds, nested by the dots in the channels' names.
TOPIC = "/channels"
SCHEMA = "sms-online/capture"
_SECOND = 1_000_000_000


def capture_writer(path: Path, channels: tuple[str, ...]) -> CaptureWriter | McapWriter:
    """The writer of a capture, .csv or .mcap, as its name ends; InputError where the file cannot be made."""
    return McapWriter(path, channels) if path.suffix == ENDING else CaptureWriter(path, channels)


class McapWriter(WholeFile):
    """Writes blocks as an MCAP file; it appears under its name when the context ends without an error.

    Times of the messages are those of the samples, to the nearest ns, from the first one where that is before 0.
    Raises InputError where the file cannot be made, or the extra `logs` is missing.
    """

    def __init__(self, path: Path, channels: tuple[str, ...]) -> None:
        writing = installed("mcap.writer", str(path))
        super().__init__(path)
        self._channels = channels
        self._paths = [channel.split(".") for channel in channels]
        self._zero = math.nan  # time of the messages' zero, s
        self._mcap = writing.Writer(self._file)
        self._mcap.start(profile="", library="sms-online")
        schema = self._mcap.register_schema(SCHEMA, "jsonschema", json.dumps(_schema(self._paths)).encode())
        self._topic = self._mcap.register_channel(TOPIC, "json", schema)

    def write(self, block: Block) -> None:
        """Append the rows of a block; ValueError where its channels are not the file's."""
        if block.channels != self._channels:
            raise ValueError(f"block of {block.channels} for a capture of {self._channels}")
        for t, row in zip(block.t.tolist(), block.values.tolist(), strict=True):
            if math.isnan(self._zero):
                self._zero = min(t, 0.0)
            message: dict[str, Any] = {"t": t}
            for path, value in zip(self._paths, row, strict=True):
                if not math.isnan(value):
                    _inside(message, path[:-1])[path[-1]] = value
            at = round((t - self._zero) * _SECOND)
            self._mcap.add_message(self._topic, at, json.dumps(message).encode(), at)

    def _complete(self) -> None:
        self._mcap.finish()


def _schema(paths: Iterable[list[str]]) -> dict[str, Any]:
    """The JSON schema of a message."""
    properties: dict[str, Any] = {"t": {"type": "number", "description": "s"}}
    for path in paths:
        fields = properties
        for name in path[:-1]:
            fields = fields.setdefault(name, {"type": "object", "properties": {}})["properties"]
        fields[path[-1]] = {"type": "number"}
    return {"title": SCHEMA, "type": "object", "properties": properties}


def _inside(message: dict[str, Any], path: Iterable[str]) -> dict[str, Any]:
    for name in path:
        message = message.setdefault(name, {})
    return message
