"""CAN logs of `candump -l`, read as arrays.

python-can's reader is not used: a line that it cannot read raises a bare ValueError without the line's number, its
objects cost 3.7 µs a frame before any signal is decoded, and its times are floats, good to 0.24 µs at this epoch, where
the log holds whole microseconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sms_adapters.lines import LineLog, sampled_line
from sms_adapters.raw import ERROR_FRAME, EXTENDED, FD_FRAME, MOST_BYTES, REMOTE_FRAME, CanFrames
from sms_online.errors import InputError
from sms_online.stream import Indices, Mask

Bytes = NDArray[np.uint8]

NANOSECONDS = 10**9
# Digits before and behind the point of a time, of an identifier, and letters of an interface (IFNAMSIZ of Linux, and
# what other makers of such logs may need).
_SECONDS, _FRACTION = 10, 9
_STANDARD_DIGITS, _EXTENDED_DIGITS = 3, 8
_INTERFACE = 64
_LATEST = 9_223_372_035  # s: whole nanoseconds of later times do not fit 64 bits
_ERROR_FLAG = 1 << 29  # CAN_ERR_FLAG of linux/can.h, which candump writes as part of the identifier
# Value of a hexadecimal digit by its character, 255 for any other.
_HEX = np.full(256, 255, dtype=np.uint8)
for _case in (b"0123456789abcdef", b"0123456789ABCDEF"):
    _HEX[np.frombuffer(_case, np.uint8)] = np.arange(16, dtype=np.uint8)
_NOT_HEX = 255


@dataclass(frozen=True)
class LoggedFrames:
    """Some consecutive frames of a log.

    Arrival and stamp are s since its first frame. bus (N,): of each, an index of `buses`.
    """

    frames: CanFrames
    bus: NDArray[np.intp]
    buses: tuple[str, ...]


class CandumpLog(LineLog):
    """A candump log, .log or .log.gz; each iteration starts from its beginning.

    Lines are `(seconds.fraction) interface id#data`, with the variants of the format: ##flags for CAN FD, R for a
    remote frame, a direction at the end. Raises InputError for a malformed line and a time that goes back.
    """

    def __iter__(self) -> Iterator[LoggedFrames]:
        """The frames, a chunk of text at a time."""
        first: int | None = None
        last = 0
        buses: dict[bytes, int] = {}
        for line, text in self._lines:
            stamps, frames, bus = parsed(self._path, line, text, buses)
            if not stamps.size:
                continue
            back = np.diff(stamps, prepend=last) < 0
            if back.any():
                number, _ = sampled_line(line, text, int(back.argmax()))
                expected = "times that do not go back"
                raise InputError(str(self._path), f"line {number}", "a time before that of the line above", expected)
            first, last = (int(stamps[0]) if first is None else first), int(stamps[-1])
            t = (stamps - first) / NANOSECONDS
            timed = CanFrames(t, t, frames.id, frames.length, frames.data, frames.flags)
            yield LoggedFrames(timed, bus, tuple(name.decode("utf-8", "replace") for name in buses))


def parsed(
    path: Path, line: int, text: memoryview, buses: dict[bytes, int]
) -> tuple[Indices, CanFrames, NDArray[np.intp]]:
    """Stamps (N,), ns, frames without times, and buses (N,) of whole lines; new buses are put into `buses`.

    path, line: of the file and of the first line, for the InputError of a malformed one.
    """
    b = np.frombuffer(text, np.uint8)
    end = np.flatnonzero(b == ord("\n"))
    start = np.concatenate(([0], end[:-1] + 1)).astype(np.int64)
    end = end - ((end > start) & (b[end - 1] == ord("\r")))
    number = np.flatnonzero(end > start)
    start, end = start[number], end[number]
    directed = (b[end - 2] == ord(" ")) & ((b[end - 1] == ord("R")) | (b[end - 1] == ord("T")))
    end = end - 2 * (directed & (end - start > 2))

    # Where the parts of each line begin; where a line lacks one, the place lies outside of it.
    point = _next(b, ".", start)
    close = _next(b, ")", point)
    space = _next(b, " ", np.minimum(close + 2, b.size - 1))
    hash_ = _next(b, "#", space)
    good = (b[start] == ord("(")) & (hash_ < end)
    hash_ = np.minimum(hash_, b.size - 2)
    good &= (b[np.minimum(close + 1, b.size - 1)] == ord(" ")) & (space > close + 2)
    seconds, fits = _digits(b, start + 1, point, _SECONDS, 10)
    good &= fits & (seconds <= _LATEST)
    fraction, fits = _digits(b, point + 1, close, _FRACTION, 10)
    good &= fits
    fraction *= 10 ** (_FRACTION - np.clip(close - point - 1, 1, _FRACTION))
    id_, fits = _digits(b, space + 1, hash_, _EXTENDED_DIGITS, 16)
    long = hash_ - space - 1 == _EXTENDED_DIGITS
    good &= fits & (long | (hash_ - space - 1 == _STANDARD_DIGITS))
    fd = b[hash_ + 1] == ord("#")
    after = np.minimum(hash_ + 1 + 2 * fd, b.size - 1)  # behind the flags of CAN FD, one digit
    good &= ~fd | (_HEX[b[np.minimum(hash_ + 2, b.size - 1)]] != _NOT_HEX) & (after <= end)
    remote = (b[after] == ord("R")) & (after < end)
    good &= ~remote | (end - after == 1) | ((end - after == 2) & (_HEX[b[end - 1]] != _NOT_HEX))
    # A remote frame states how many bytes it asks for, and holds none.
    asked = np.where(end - after == 2, _HEX[b[end - 1]], 0)
    length = np.where(remote, asked, (end - after) // 2)
    good &= remote | ((end - after) % 2 == 0) & (length <= MOST_BYTES)
    data, fits = _data(b, after, np.where(good & ~remote, length, 0))
    good &= fits
    bus, fits = _names(b, close + 2, space, good, buses)
    good &= fits
    if not good.all():
        k = int(number[good.argmin()])
        found = repr(bytes(text).split(b"\n")[k][:60].decode("utf-8", "replace"))
        expected = "(seconds) interface id#data, as candump -l writes"
        raise InputError(str(path), f"line {line + k}", found, expected)
    error = long & ((id_ & _ERROR_FLAG) != 0)
    ids = np.where(long, id_ & (_ERROR_FLAG - 1) | EXTENDED, id_).astype(np.uint32)
    flags = (error * ERROR_FRAME | remote * REMOTE_FRAME | fd * FD_FRAME).astype(np.uint8)
    unknown = np.full(number.size, np.nan)
    frames = CanFrames(unknown, unknown, ids, length.astype(np.uint8), data, flags)
    return seconds * NANOSECONDS + fraction, frames, bus


def _next(b: Bytes, character: str, start: Indices) -> Indices:
    """Place of the first such character from each start on; the text's size where there is none."""
    places = np.append(np.flatnonzero(b == ord(character)), b.size)
    return np.asarray(places[np.searchsorted(places[:-1], start)], dtype=np.int64)


def _digits(b: Bytes, start: Indices, stop: Indices, most: int, base: int) -> tuple[Indices, Mask]:
    """Numbers of 1 to `most` digits from start to stop, and which of them are such numbers."""
    width = stop - start
    good = (width >= 1) & (width <= most)
    value = np.zeros(start.size, dtype=np.int64)
    for k in range(int(width[good].max(initial=0))):
        digit = _HEX[b[np.minimum(start + k, b.size - 1)]]
        inside = k < width
        good &= ~inside | (digit < base)
        value = np.where(inside, value * base + digit, value)
    return value, good


def _data(b: Bytes, start: Indices, length: Indices) -> tuple[Bytes, Mask]:
    """(N, 64) bytes from pairs of hexadecimal digits, and which frames have nothing else in them."""
    data = np.zeros((start.size, MOST_BYTES), dtype=np.uint8)
    good = np.ones(start.size, dtype=np.bool_)
    for k in range(int(length.max(initial=0))):
        inside = k < length
        place = np.where(inside, start + 2 * k, 0)
        high, low = _HEX[b[place]], _HEX[b[place + 1]]
        good &= ~inside | ((high != _NOT_HEX) & (low != _NOT_HEX))
        data[:, k] = np.where(inside, high << 4 | low & 0xF, 0)
    return data, good


def _names(
    b: Bytes, start: Indices, stop: Indices, good: Mask, buses: dict[bytes, int]
) -> tuple[NDArray[np.intp], Mask]:
    """Index in `buses` of the name from start to stop, which is extended by new ones; which lines have such a name."""
    width = np.where(good, stop - start, 0)
    good = good & (width <= _INTERFACE)
    width = np.where(good, width, 0)
    letters = np.zeros((start.size, max(1, int(width.max(initial=0)))), dtype=np.uint8)
    for k in range(letters.shape[1]):
        inside = k < width
        letters[:, k] = np.where(inside, b[np.minimum(start + k, b.size - 1)], 0)
        good &= ~inside | (letters[:, k] > ord(" "))
    index = np.zeros(start.size, dtype=np.intp)
    left = good.copy()
    while left.any():
        row = int(left.argmax())
        same = (letters == letters[row]).all(axis=1) & left
        index[same] = buses.setdefault(letters[row].tobytes().rstrip(b"\0"), len(buses))
        left &= ~same
    return index, good
