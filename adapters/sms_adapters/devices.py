"""The reader and the decoder of a described source: a further one is an entry of READERS or DECODERS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sms_adapters.can_decoder import CanDecoder
from sms_adapters.can_reader import CanReader
from sms_adapters.can_signals import wanted_messages
from sms_adapters.canopen_signals import pdo_messages
from sms_adapters.datagram_reader import DatagramReader
from sms_adapters.natnet_decoder import NatnetDecoder
from sms_adapters.raw import Clock, Decoder, Reader, Turn, at_once
from sms_adapters.serial_decoder import FrameDecoder, LineDecoder
from sms_adapters.serial_reader import SerialReader
from sms_online.description.record import Record
from sms_online.description.sources import (
    CanBus,
    CanopenSource,
    CanSource,
    DatagramPort,
    Device,
    NatnetSource,
    SerialFrames,
    SerialLines,
    SerialPort,
)


def make_reader(source: Device, clock: Clock, turn: Turn = at_once) -> Reader:
    """The reader of a source's device, not yet open; clock: of the session. turn: called before each fetch."""
    return next(READERS[each] for each in type(source).__mro__ if each in READERS)(source, clock, turn)


def make_decoder(source: Device, directory: Path | None) -> Decoder:
    """The decoder of a source's raw items.

    directory: where the system file lies, with its DBC or EDS beside it. Raises InputError where those do not fit the
    source, or a package is missing.
    """
    return DECODERS[type(source)](source, directory)


def make_can_decoder(source: CanSource | CanopenSource, directory: Path | None) -> CanDecoder:
    """The decoder of a CAN source, with the messages that its DBC or EDS describes."""
    messages = wanted_messages(source, directory) if isinstance(source, CanSource) else pdo_messages(source, directory)
    return CanDecoder(messages, tuple(source.signals.values()))


# What reads each kind of port, and what decodes the bytes of each described source.
READERS: dict[type[Record], Callable[[Any, Clock, Turn], Reader]] = {
    CanBus: lambda source, clock, turn: CanReader(source, clock, turn=turn),
    SerialPort: SerialReader,
    DatagramPort: DatagramReader,
}
DECODERS: dict[type[Record], Callable[[Any, Path | None], Decoder]] = {
    CanSource: make_can_decoder,
    CanopenSource: make_can_decoder,
    SerialFrames: lambda source, directory: FrameDecoder(source),
    SerialLines: lambda source, directory: LineDecoder(source),
    NatnetSource: lambda source, directory: NatnetDecoder(source),
}
