"""CAN signals as a DBC describes them: found by name, decoded for all frames of a message at once.

cantools reads the DBC; its signal descriptions then steer shifts and masks over arrays, with the values of its own
decoder at a fraction of its 1.7 µs a frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import cantools.database.errors
import numpy as np
from cantools.database.can import Message, Signal
from numpy.typing import NDArray

from sms_online.description.explain import nearest
from sms_online.description.schema import CanSource, System
from sms_online.errors import InputError
from sms_online.stream import Array

_FLOATS = {16: np.float16, 32: np.float32, 64: np.float64}


@dataclass(frozen=True)
class WantedMessage:
    """A message that channels come from: its DBC description, the signals wanted of it and their columns in a block."""

    message: Message
    signals: tuple[Signal, ...]
    columns: NDArray[np.intp]

    def decode(self, frames: NDArray[np.uint8]) -> Array:
        """(B, signals) values from frames (B, bytes of the message)."""
        return np.stack([decode_signal(signal, frames) for signal in self.signals], axis=1)


def wanted_messages(system: System, source: CanSource, directory: Path | None) -> list[WantedMessage]:
    """The messages of source.signals, columns in its order; the DBC from the system's directory or among those shipped.

    Raises InputError for a DBC that is missing or unreadable, a message or signal it does not hold, a multiplexed
    signal, and a channel fed by two signals.
    """
    place = f"system {system.name}, [source]"
    database = _read_dbc(place, source.dbc, directory)
    if len(set(source.signals.values())) < len(source.signals):
        raise InputError(place, "signals", "two signals for one channel", "each channel once")
    messages = {message.name: message for message in database.messages}
    wanted: dict[str, list[tuple[int, Signal]]] = {}
    for column, name in enumerate(source.signals):
        message_name, _, signal_name = name.partition(".")
        if message_name not in messages:
            raise _unknown(place, name, [f"{m.name}.{s.name}" for m in database.messages for s in m.signals])
        message = messages[message_name]
        found = [signal for signal in message.signals if signal.name == signal_name]
        if not found:
            raise _unknown(place, name, [f"{message_name}.{signal.name}" for signal in message.signals])
        if found[0].multiplexer_ids:
            raise InputError(
                place, f"signals, {name}", "a multiplexed signal", "one that every frame of its message holds"
            )
        wanted.setdefault(message_name, []).append((column, found[0]))
    return [
        WantedMessage(messages[name], tuple(signal for _, signal in pairs), np.array([column for column, _ in pairs]))
        for name, pairs in wanted.items()
    ]


def decode_signal(signal: Signal, frames: NDArray[np.uint8]) -> Array:
    """(B,) values of a signal, scale and offset applied, from frames (B, bytes).

    Equal to the bit to cantools' own, up to words of 53 bits.
    """
    raw = np.zeros(len(frames), dtype=np.uint64)
    for byte, low, width in _pieces(signal):
        piece = (frames[:, byte] >> np.uint8(low)) & np.uint8((1 << width) - 1)
        raw = (raw << np.uint64(width)) | piece
    if signal.is_float:
        word = raw.astype(f"u{signal.length // 8}").view(_FLOATS[signal.length]).astype(np.float64)
    elif signal.is_signed:
        # To the top of the word and back, which brings the sign bit down with it.
        unused = 64 - signal.length
        word = ((raw << np.uint64(unused)).view(np.int64) >> np.int64(unused)).astype(np.float64)
    else:
        word = raw.astype(np.float64)
    return word * float(signal.scale) + float(signal.offset)


def _pieces(signal: Signal) -> list[tuple[int, int, int]]:
    """(byte, lowest bit, width) of the runs of bits that make up a signal, the most significant run first.

    DBC numbers the bits of a frame 8 byte + bit, bit 0 the lowest of its byte. A little-endian signal starts at its
    lowest bit and runs up through the numbers; a big-endian one starts at its highest and runs down each byte, then on
    to the next.
    """
    pieces = []
    byte, bit = divmod(signal.start, 8)
    left = signal.length
    while left:
        if signal.byte_order == "big_endian":
            width = min(left, bit + 1)
            pieces.append((byte, bit + 1 - width, width))
            bit = 7
        else:
            width = min(left, 8 - bit)
            pieces.append((byte, bit, width))
            bit = 0
        byte += 1
        left -= width
    return pieces if signal.byte_order == "big_endian" else pieces[::-1]


def _read_dbc(place: str, name: str, directory: Path | None) -> cantools.database.can.Database:
    shipped = resources.files("sms_adapters") / "dbc"
    beside = None if directory is None else directory / name
    if beside is not None and beside.is_file():
        text = beside.read_text(encoding="cp1252")  # the encoding of the format, and of cantools
    elif "/" not in name and (shipped / name).is_file():
        text = (shipped / name).read_text(encoding="cp1252")
    else:
        names = ", ".join(sorted(file.name for file in shipped.iterdir()))
        raise InputError(place, "dbc", f"no file {name!r}", f"a file beside the system file, or a shipped one: {names}")
    try:
        database = cantools.database.load_string(text, "dbc")
    except (cantools.database.errors.Error, ValueError) as error:
        raise InputError(place, f"dbc {name}", " ".join(str(error).split())[:120], "a readable DBC") from None
    assert isinstance(database, cantools.database.can.Database)  # what "dbc" always gives
    return database


def _unknown(place: str, name: str, names: Sequence[str]) -> InputError:
    expected = f"a signal of it, such as {nearest(name, names) or names[0]!r}" if names else "a DBC with signals"
    return InputError(place, "signals", f"{name!r}, which the DBC does not hold", expected)
