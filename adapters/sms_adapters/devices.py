"""The reader and the decoder of a described source."""

from __future__ import annotations

from pathlib import Path

from sms_adapters.can_decoder import CanDecoder
from sms_adapters.can_reader import CanReader
from sms_adapters.can_signals import wanted_messages
from sms_adapters.canopen_signals import pdo_messages
from sms_adapters.datagram_reader import DatagramReader
from sms_adapters.natnet_decoder import NatnetDecoder
from sms_adapters.raw import Clock, Decoder, Reader, Turn, at_once
from sms_adapters.serial_decoder import FrameDecoder, LineDecoder
from sms_adapters.serial_reader import SerialReader
from sms_online.description.sources import CanopenSource, CanSource, Device, NatnetSource, SerialFrames


def make_reader(source: Device, clock: Clock, turn: Turn = at_once) -> Reader:
    """The reader of a source's device, not yet open; clock: of the session. turn: called before each fetch."""
    if isinstance(source, CanSource | CanopenSource):
        return CanReader(source, clock, turn=turn)
    if isinstance(source, NatnetSource):
        return DatagramReader(source, clock, turn)
    return SerialReader(source, clock, turn)


def make_decoder(source: Device, directory: Path | None) -> Decoder:
    """The decoder of a source's raw items.

    directory: where the system file lies, with its DBC or EDS beside it. Raises InputError where those do not fit the
    source, or a package is missing.
    """
    if isinstance(source, CanSource | CanopenSource):
        return make_can_decoder(source, directory)
    if isinstance(source, SerialFrames):
        return FrameDecoder(source)
    if isinstance(source, NatnetSource):
        return NatnetDecoder(source)
    return LineDecoder(source)


def make_can_decoder(source: CanSource | CanopenSource, directory: Path | None) -> CanDecoder:
    """The decoder of a CAN source, with the messages that its DBC or EDS describes."""
    messages = wanted_messages(source, directory) if isinstance(source, CanSource) else pdo_messages(source, directory)
    return CanDecoder(messages, tuple(source.signals.values()))
