"""CAN signals as a DBC describes them: found by name, decoded for all frames of a message at once.

cantools reads the DBC; its signal descriptions then steer shifts and masks over arrays, with the values of its own
decoder at a fraction of its 1.7 µs a frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

import cantools.database.errors
import numpy as np
from cantools.database.can import Message, Signal
from numpy.typing import NDArray

from sms_adapters.raw import EXTENDED, one_line
from sms_online.description.explain import nearest
from sms_online.description.sources import CanSource
from sms_online.errors import InputError
from sms_online.grouping import grouped
from sms_online.stream import Array, Mask

CLASSIC_BYTES = 8  # of a frame that is not CAN FD
_MOST_BITS = 32  # of a counter
_FLOATS = {16: np.float16, 32: np.float32, 64: np.float64}


# Multiplexers and the values of each, all of which must hold in a frame.
Condition = tuple[tuple[Signal, tuple[int, ...]], ...]


@dataclass(frozen=True)
class Part:
    """Signals of a message that come in the same frames, and their columns in a block."""

    signals: tuple[Signal, ...]
    columns: tuple[int, ...]
    condition: Condition

    def held(self, frames: NDArray[np.uint8]) -> Mask:
        """(B,) mask of the frames (B, bytes) of the message that hold these signals."""
        held = np.ones(len(frames), dtype=np.bool_)
        for multiplexer, values in self.condition:
            held &= np.isin(raw_word(multiplexer, frames), np.array(values, dtype=np.uint64))
        return held


@dataclass(frozen=True)
class WantedMessage:
    """A message that channels come from.

    id: with EXTENDED set for 29 bits. length: bytes. signals: those wanted of it, and their columns in a block.
    counter: the signal in which the sender counts its frames, if it does. conditions: of each signal, where some are
    multiplexed.
    """

    name: str
    id: int
    length: int
    signals: tuple[Signal, ...]
    columns: tuple[int, ...]
    counter: Signal | None = None
    conditions: tuple[Condition, ...] = ()

    @property
    def parts(self) -> list[Part]:
        """The signals in groups that come in the same frames."""
        conditions = self.conditions or [()] * len(self.signals)
        groups = grouped((condition, k) for k, condition in enumerate(conditions))
        return [
            Part(tuple(self.signals[k] for k in group), tuple(self.columns[k] for k in group), condition)
            for condition, group in groups.items()
        ]

    def words(self, frames: NDArray[np.uint8], rows: NDArray[np.intp]) -> NDArray[np.uint8]:
        """Bytes of those rows of frames (N, 64) that are this message's: a classic frame's whole word at least."""
        return frames[rows, : max(self.length, CLASSIC_BYTES)]


def wanted_messages(source: CanSource, directory: Path | None) -> list[WantedMessage]:
    """The messages that channels come from, their columns in the order of source.signals.

    The DBC lies in the system's directory or is a shipped one. Raises InputError for a DBC that is missing or
    unreadable, a message or signal it does not hold, and a counter of a message that no channel comes from, that is not
    a plain unsigned number, or that not every frame holds.
    """
    place = f"source {source.name}"
    database = _read_dbc(place, source.dbc, directory)
    messages = {message.name: message for message in database.messages}
    wanted = grouped(
        (name.split(".")[0], (column, _find(place, "signals", name, messages)))
        for column, name in enumerate(source.signals)
    )
    counters: dict[str, Signal] = {}
    for name in source.counters:
        message_name, signal = name.split(".")[0], _find(place, "counters", name, messages)
        if message_name not in wanted:
            raise InputError(place, f"counters, {name}", "no channel comes from its message", "a message of signals")
        if signal.is_signed or signal.is_float or signal.scale != 1 or signal.offset != 0 or signal.length > _MOST_BITS:
            expected = f"an unsigned whole number of at most {_MOST_BITS} bits"
            raise InputError(place, f"counters, {name}", "a number with sign or scale, or a longer one", expected)
        if signal.multiplexer_ids:
            expected = "one that every frame of its message holds"
            raise InputError(place, f"counters, {name}", "a multiplexed signal", expected)
        counters[message_name] = signal
    return [
        WantedMessage(
            name,
            messages[name].frame_id | (EXTENDED if messages[name].is_extended_frame else 0),
            messages[name].length,
            tuple(signal for _, signal in pairs),
            tuple(column for column, _ in pairs),
            counters.get(name),
            tuple(_condition(messages[name], signal) for _, signal in pairs),
        )
        for name, pairs in wanted.items()
    ]


def decode_signal(signal: Signal, frames: NDArray[np.uint8]) -> Array:
    """(B,) values of a signal, scale and offset applied, from frames (B, bytes).

    Equal to the bit to cantools' own, up to words of 53 bits.
    """
    raw = raw_word(signal, frames)
    if signal.is_float:
        # A word that is no number (a signalling NaN) is counted later, by whoever looks at the values.
        with np.errstate(invalid="ignore"):
            word = raw.astype(f"u{signal.length // 8}").view(_FLOATS[signal.length]).astype(np.float64)
    elif signal.is_signed:
        # To the top of the word and back, which brings the sign bit down with it.
        unused = 64 - signal.length
        word = ((raw << np.uint64(unused)).view(np.int64) >> np.int64(unused)).astype(np.float64)
    else:
        word = raw.astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        return word * float(signal.scale) + float(signal.offset)


def raw_word(signal: Signal, frames: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """(B,) bits of a signal from frames (B, bytes), as an unsigned number."""
    place = _in_a_word(signal)
    if frames.shape[1] >= CLASSIC_BYTES and place is not None:
        order, down, mask = place
        whole = np.ascontiguousarray(frames[:, :CLASSIC_BYTES]).view(order)[:, 0]
        return (whole.astype(np.uint64, copy=False) >> down) & mask
    raw = np.zeros(len(frames), dtype=np.uint64)
    for byte, low, width in _pieces(signal):
        piece = (frames[:, byte] >> np.uint8(low)) & np.uint8((1 << width) - 1)
        raw = (raw << np.uint64(width)) | piece
    return raw


@cache
def _in_a_word(signal: Signal) -> tuple[str, np.uint64, np.uint64] | None:
    """Byte order, lowest bit and mask of a signal within the bytes of a classic frame, which are one word."""
    pieces = _pieces(signal)
    if max(byte for byte, _, _ in pieces) >= CLASSIC_BYTES:
        return None
    byte, low, _ = pieces[-1]
    little = signal.byte_order == "little_endian"
    down = 8 * (byte if little else CLASSIC_BYTES - 1 - byte) + low
    return "<u8" if little else ">u8", np.uint64(down), np.uint64((1 << signal.length) - 1)


@cache
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


def _find(place: str, key: str, name: str, messages: dict[str, Message]) -> Signal:
    """The signal MESSAGE.SIGNAL; InputError where there is none."""
    message_name, signal_name = name.split(".")
    if message_name not in messages:
        raise _unknown(place, key, name, [f"{m.name}.{s.name}" for m in messages.values() for s in m.signals])
    message = messages[message_name]
    found = [signal for signal in message.signals if signal.name == signal_name]
    if not found:
        raise _unknown(place, key, name, [f"{message_name}.{signal.name}" for signal in message.signals])
    return found[0]


def _condition(message: Message, signal: Signal) -> Condition:
    """Which frames of a message hold a signal: a multiplexer may itself be multiplexed."""
    if not signal.multiplexer_ids:
        return ()
    assert signal.multiplexer_signal is not None  # as it has values of one
    multiplexer = message.get_signal_by_name(signal.multiplexer_signal)
    return (*_condition(message, multiplexer), (multiplexer, tuple(signal.multiplexer_ids)))


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
        raise InputError(place, f"dbc {name}", one_line(error), "a readable DBC") from None
    assert isinstance(database, cantools.database.can.Database)  # what "dbc" always gives
    return database


def _unknown(place: str, key: str, name: str, names: Sequence[str]) -> InputError:
    expected = f"a signal of it, such as {nearest(name, names) or names[0]!r}" if names else "a DBC with signals"
    return InputError(place, key, f"{name!r}, which the DBC does not hold", expected)
