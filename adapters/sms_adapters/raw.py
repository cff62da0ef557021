"""What devices deliver before anything interprets it, and the two halves of a live source: a reader and a decoder.

A reader turns a device into raw items, stamped as they arrive; a decoder turns raw items into samples. Only raw items
are recorded, so that a replay runs through the same decoder as the session did.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sms_adapters.conversion import Turns
from sms_online.stream import Array, Mask

# Bit of CanFrames.id, as socketcan's CAN_EFF_FLAG: 0x123 and the extended 0x00000123 are two identifiers.
EXTENDED = 0x8000_0000
# Bits of CanFrames.flags.
ERROR_FRAME, REMOTE_FRAME, FD_FRAME = 1, 2, 4
# Most bytes of a frame, that of CAN FD; classic CAN uses the first eight.
MOST_BYTES = 64

# The session's clock: s, not decreasing.
Clock = Callable[[], float]
# What a reader calls before it fetches what has come: it may wait a little, while somebody else needs the interpreter.
Turn = Callable[[], None]


def at_once() -> None:
    """The turn of a reader that has nobody to wait for."""


@dataclass(frozen=True)
class CanFrames:
    """N raw CAN frames of one source, in order of arrival.

    arrival: (N,) s on the session's clock, not decreasing. stamp: (N,) s, as the device or the kernel stamped them on
    a clock of its own, NaN where there is no stamp. id: (N,), EXTENDED set for 29 bits. length: (N,) bytes.
    data: (N, 64), zero beyond the length. flags: (N,) bits ERROR_FRAME, REMOTE_FRAME, FD_FRAME.
    """

    arrival: Array
    stamp: Array
    id: NDArray[np.uint32]
    length: NDArray[np.uint8]
    data: NDArray[np.uint8]
    flags: NDArray[np.uint8]

    def __len__(self) -> int:
        return self.arrival.size

    def __getitem__(self, rows: slice | Mask | NDArray[np.intp]) -> CanFrames:
        """The frames of some rows: a slice, a mask (N,) or indices."""
        return CanFrames(*(getattr(self, field.name)[rows] for field in fields(self)))


@dataclass(frozen=True)
class SerialChunk:
    """Bytes as they were read at once from a serial port, or came in one datagram.

    arrival: when the last was there, s on the session's clock. No bytes mark a break: the port was opened, and what
    comes next may begin in the middle of a frame or a line.
    """

    arrival: float
    data: bytes


Raw = CanFrames | SerialChunk


def concatenate_frames(parts: Sequence[CanFrames]) -> CanFrames:
    """The frames of one or more parts, one after the other."""
    return CanFrames(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(CanFrames)))


class LostDevice(OSError):  # noqa: N818 - what happened to it, as KeyboardInterrupt and StopIteration say
    """A device that cannot be opened, was unplugged or is bus-off: name of its source, and why."""

    def __init__(self, name: str, why: str) -> None:
        self.name = name
        self.why = why
        super().__init__(f"{name}: {why}")


def one_line(error: BaseException) -> str:
    """The message of an exception on one line."""
    return " ".join(str(error).split())[:120] or type(error).__name__


class Reader(Protocol):
    """A device. Used from one thread; after LostDevice it may be closed and opened again.

    name: of its source. Arrivals are taken from the clock that the reader was made with.
    """

    name: str

    def open(self) -> None:
        """Open the device; raises LostDevice where that fails."""

    def read(self, timeout: float) -> list[Raw]:
        """What has come, waiting at most `timeout` s for the first of it; [] where nothing came.

        Raises LostDevice where the device is gone.
        """

    def close(self) -> None:
        """Release the device; never raises, and closing twice is no error."""


@dataclass(frozen=True)
class DecodedSamples:
    """M samples of one source, in order of arrival.

    t_arrival: (M,) s on the session's clock. t_device: (M,) s on the clock of the device, NaN where it sends no time;
    roll-overs of its counter are undone. values: (M, C) SI units, NaN in channels that a sample does not hold.
    """

    t_arrival: Array
    t_device: Array
    values: Array


class Decoder(Protocol):
    """Makes samples of raw items. The same items give the same samples, however they are grouped in pushes.

    channels: C names. counters: what was skipped so far, by kind of fault; every kind is there from the start. turns:
    of the channels whose numbers wrap, which a resumed session goes on with.
    """

    channels: tuple[str, ...]
    counters: dict[str, int]
    turns: dict[str, Turns]

    def push(self, *items: Raw) -> DecodedSamples:
        """The samples that one or more items complete, M from 0 up. Whatever the bytes, it counts and never raises."""
