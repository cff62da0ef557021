"""Bytes of a serial port to samples: binary frames (COBS and CRC-32) and lines of ASCII numbers."""

from __future__ import annotations

import re
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterable

import numpy as np
from cobs import cobs
from numpy.typing import NDArray

from sms_adapters.conversion import Conversions, FrameCounter, Turns
from sms_adapters.raw import DecodedSamples, Raw, SerialChunk
from sms_online.description.sources import FrameField, SerialField, SerialFrames, SerialLines
from sms_online.stream import Array

# Longest line that is kept, bytes: no described line comes near it, and a stream without ends must not fill the memory.
LONGEST_LINE = 4096
# COBS makes of 254 bytes at most 255, and adds one.
_COBS_RUN = 254
_CRC_BYTES = 4
# What COBS has no byte of.
FRAME_END = b"\0"
# What the CRC-32 of any bytes followed by their own CRC-32, little-endian, comes to.
_CRC_RESIDUE = 0x2144DF1C
# Wrap of a count that is never said to wrap: where float64 ends to hold every whole number.
_NEVER = 1 << 53

_NUMBER = rb"[-+]?(?:\d+(?:\.\d*)?(?:e[-+]?\d+)?|\.\d+(?:e[-+]?\d+)?|nan|inf(?:inity)?)"
_XOR = re.compile(rb"\$?([^*]*)\*([0-9A-Fa-f]{2})[ \t]*")


class Items:
    """Cuts a stream of bytes at a delimiter, with bounded memory.

    Pieces longer than `longest` are dropped and counted. After a break (see SerialChunk) the first piece is dropped,
    for nothing shows that it is whole (cut_line): a sender that begins with a delimiter loses nothing by that.
    """

    def __init__(self, delimiter: bytes, longest: int, counters: dict[str, int]) -> None:
        self._delimiter = delimiter
        self._longest = longest
        self._counters = counters
        self._tail = b""
        self._overlong = False  # the tail, which is then no longer kept
        self._cut = False  # the tail's beginning is missing

    def push(self, data: bytes) -> list[bytes]:
        """The pieces that are complete now, without their delimiters and without empty ones."""
        if not data:
            self._tail, self._overlong, self._cut = b"", False, True
            return []
        *pieces, tail = (self._tail + data).split(self._delimiter)
        if pieces and (self._cut or self._overlong):
            if pieces[0] or self._overlong:
                self._counters["cut_line" if self._cut else "too_long"] += 1
            self._cut = self._overlong = False
            del pieces[0]
        self._overlong |= len(tail) > self._longest
        self._tail = b"" if self._overlong else tail
        whole = [piece for piece in pieces if len(piece) <= self._longest]
        self._counters["too_long"] += len(pieces) - len(whole)
        return [piece for piece in whole if piece]


class Fields:
    """The numbers of consecutive frames or lines to samples: counter, device time, channels.

    moduli: for each field, where its count wraps without saying, 0 for never.
    """

    KINDS = ("bad_number", *FrameCounter.KINDS, "non_finite", "out_of_range")

    def __init__(self, fields: Iterable[SerialField], moduli: Iterable[int], counters: dict[str, int]) -> None:
        self._counters = counters
        self._counter: tuple[int, FrameCounter] | None = None
        self._time: tuple[int, float, Turns] | None = None
        self._wraps: list[tuple[int, int]] = []  # of the columns that count
        described = []
        self._columns: list[int] = []  # of the numbers, those of the channels
        for k, (field, modulus) in enumerate(zip(fields, moduli, strict=True)):
            wrap = int(field.wrap or modulus or _NEVER)
            if field.channel is not None:
                described.append(field)
                self._columns.append(k)
            if field.counter:
                self._counter = (k, FrameCounter(wrap, counters))
            if field.tick is not None:
                self._time = (k, field.tick, Turns(wrap))
            if field.counter or field.tick is not None:
                self._wraps.append((k, wrap))
        self.channels = tuple(field.channel for field in described if field.channel is not None)
        self._conversions = Conversions(described, counters)
        self.turns = self._conversions.turns

    def samples(self, arrival: Array, numbers: Array) -> DecodedSamples:
        """Samples from numbers (M, fields) that came at (M,), s; a count that is no count is a bad_number."""
        good = np.ones(len(numbers), dtype=np.bool_)
        for k, wrap in self._wraps:
            count = numbers[:, k]
            good &= (count >= 0) & (count < wrap) & (count == np.floor(count))
        if not good.all():
            self._counters["bad_number"] += int(np.count_nonzero(~good))
            arrival, numbers = arrival[good], numbers[good]
        if self._counter is not None:
            k, sequence = self._counter
            admitted = sequence.admit(numbers[:, k].astype(np.int64))
            if not admitted.all():
                arrival, numbers = arrival[admitted], numbers[admitted]
        t_device = np.full(len(numbers), np.nan)
        if self._time is not None:
            k, tick, turns = self._time
            t_device = (numbers[:, k] + turns.count(numbers[:, k]) * turns.wrap) * tick
        values = self._conversions(numbers[:, self._columns])
        # A frame whose every value was refused is no sample.
        used = ~np.isnan(values).all(axis=1)
        return DecodedSamples(arrival[used], t_device[used], values[used])


class _SerialDecoder(ABC):
    """What frames and lines have in common."""

    def __init__(self, items: Items, fields: Fields, counters: dict[str, int]) -> None:
        self.channels, self.turns = fields.channels, fields.turns
        self.counters = counters
        self._items = items
        self._fields = fields

    def push(self, *items: Raw) -> DecodedSamples:
        """The samples that chunks complete; t_arrival is that of the chunk with the last byte."""
        pieces: list[bytes] = []
        arrival: list[float] = []
        for item in items:
            if not isinstance(item, SerialChunk):
                raise TypeError(f"{type(item).__name__} pushed into a decoder of bytes")
            complete = self._items.push(item.data)
            pieces += complete
            arrival += [item.arrival] * len(complete)
        good, numbers = self._numbers(pieces)
        return self._fields.samples(np.array(arrival, dtype=np.float64)[good], numbers)

    @abstractmethod
    def _numbers(self, pieces: list[bytes]) -> tuple[list[int], Array]:
        """Which of the pieces are as described, and their numbers (M, fields); the others are counted."""


class FrameDecoder(_SerialDecoder):
    """Decodes binary frames as SerialFrames describes them: a `Decoder`.

    framing counts pieces that are no COBS or of another length, crc those with a wrong checksum.
    """

    def __init__(self, source: SerialFrames) -> None:
        counters = dict.fromkeys(("cut_line", "too_long", "framing", "crc", *Fields.KINDS), 0)
        layout = frame_layout(source.fields)
        self._names = layout.names or ()
        # The checksum stays on, so that no frame is copied for it.
        self._layout = np.dtype([*((name, layout[name]) for name in self._names), ("crc", f"V{_CRC_BYTES}")])
        self._size = self._layout.itemsize
        moduli = [1 << int(field.type[1:]) if field.type[0] == "u" else 0 for field in source.fields]
        longest = self._size + self._size // _COBS_RUN + 1
        super().__init__(Items(FRAME_END, longest, counters), Fields(source.fields, moduli, counters), counters)

    def _numbers(self, pieces: list[bytes]) -> tuple[list[int], Array]:
        good: list[int] = []
        frames: list[bytes] = []
        for k, piece in enumerate(pieces):
            try:
                frame = cobs.decode(piece)
            except cobs.DecodeError:
                frame = b""
            if len(frame) != self._size:
                self.counters["framing"] += 1
            elif zlib.crc32(frame) != _CRC_RESIDUE:
                self.counters["crc"] += 1
            else:
                good.append(k)
                frames.append(frame)
        words = np.frombuffer(b"".join(frames), self._layout)
        # A signalling NaN is counted as non_finite like any other.
        with np.errstate(invalid="ignore"):
            return good, np.stack([words[name].astype(np.float64) for name in self._names], axis=1)


class LineDecoder(_SerialDecoder):
    """Decodes lines as SerialLines describes them: a `Decoder`.

    crc counts lines with a wrong or missing checksum, non_utf8 those that are no text, bad_number those that are not
    the described numbers. `nan` and `inf` are numbers, counted as non_finite.
    """

    def __init__(self, source: SerialLines) -> None:
        counters = dict.fromkeys(("cut_line", "too_long", "crc", "non_utf8", *Fields.KINDS), 0)
        self._checked = source.checksum == "xor"
        self._separator = source.separator.encode() or None
        between = rb"[ \t]*" + re.escape(self._separator) + rb"[ \t]*" if self._separator else rb"[ \t]+"
        line = rb"[ \t]*" + between.join([_NUMBER] * len(source.fields)) + rb"[ \t\r]*"
        self._line = re.compile(line, re.IGNORECASE)
        self._count = len(source.fields)
        fields = Fields(source.fields, [0] * self._count, counters)
        super().__init__(Items(b"\n", LONGEST_LINE, counters), fields, counters)

    def _numbers(self, pieces: list[bytes]) -> tuple[list[int], Array]:
        rows = [(k, row) for k, piece in enumerate(pieces) if (row := self._row(piece)) is not None]
        return [k for k, _ in rows], np.array([row for _, row in rows], dtype=np.float64).reshape(-1, self._count)

    def _row(self, line: bytes) -> list[float] | None:
        if not line.strip():
            return None
        if self._checked:
            parts = _XOR.fullmatch(line.rstrip(b"\r"))
            if parts is None or int(np.bitwise_xor.reduce(np.frombuffer(parts[1], np.uint8))) != int(parts[2], 16):
                self._skip(line, "crc")
                return None
            line = parts[1]
        if self._line.fullmatch(line) is None:
            self._skip(line, "bad_number")
            return None
        return [float(cell) for cell in line.split(self._separator)]

    def _skip(self, line: bytes, kind: str) -> None:
        """Count a line that is skipped, as text of this kind or as none."""
        try:
            line.decode()
        except UnicodeDecodeError:
            kind = "non_utf8"
        self.counters[kind] += 1


def frame_layout(fields: Iterable[FrameField]) -> np.dtype[np.void]:
    """The words of a frame without its CRC, as the little-endian record that they are."""
    return np.dtype([(f"f{k}", f"<{field.type[0]}{int(field.type[1:]) // 8}") for k, field in enumerate(fields)])


def encode_frames(words: NDArray[np.void]) -> list[bytes]:
    """Frames as a device sends them, delimiters included, of words (M,) of a `frame_layout`."""
    payloads = (word.tobytes() for word in words)
    return [cobs.encode(data + zlib.crc32(data).to_bytes(_CRC_BYTES, "little")) + FRAME_END for data in payloads]
