"""Samples as a described device sends them: the inverse of the decoders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cantools.database.can.signal import Signal as CanSignal
from numpy.typing import NDArray

from sms_adapters.can_signals import WantedMessage, wanted_messages
from sms_adapters.raw import MOST_BYTES, CanFrames
from sms_adapters.serial_decoder import FRAME_END, encode_frames, frame_layout
from sms_online.description.schema import System
from sms_online.description.sources import CanSource, SerialFrames, Signal
from sms_online.errors import InputError
from sms_online.stream import Array, Block, Indices

# Longest classic frame: what is packed into one word of 64 bits.
LONGEST_FRAME = 8


@dataclass(frozen=True)
class DeviceClock:
    """A device's own clock: at the instant t it shows (t - offset) / (1 + drift), s."""

    offset: float = 0.0
    drift: float = 0.0

    def __call__(self, t: Array) -> Array:
        """What it shows at instants t (B,)."""
        return (t - self.offset) / (1.0 + self.drift)


class CanDevice:
    """Nodes on a CAN bus, one message each, counting their frames. Instants are in the simulation's time.

    Raises InputError for messages longer than eight bytes, or big-endian ones.
    """

    def __init__(self, source: CanSource, directory: Path | None) -> None:
        self.name = source.name
        self._messages = wanted_messages(source, directory)
        self._signals = tuple(source.signals.values())
        self._counts = [0] * len(self._messages)
        for message in self._messages:
            for signal in (*message.signals, *([message.counter] if message.counter else [])):
                if message.length > LONGEST_FRAME or signal.byte_order != "little_endian":
                    found = f"message {message.name}"
                    raise InputError(f"source {source.name}", "dbc", found, "little-endian, of at most eight bytes")

    def encode(self, block: Block) -> list[tuple[Array, CanFrames]]:
        """For each message the instants (M,) of its samples, and their frames; arrival is the instant."""
        return [self._frames(k, message, block) for k, message in enumerate(self._messages)]

    def _frames(self, k: int, message: WantedMessage, block: Block) -> tuple[Array, CanFrames]:
        columns = [block.channels.index(self._signals[column].channel) for column in message.columns]
        rows = np.flatnonzero(~np.isnan(block.values[:, columns]).any(axis=1))
        word = np.zeros(rows.size, dtype=np.uint64)
        for signal, column, described in zip(
            message.signals, columns, [self._signals[c] for c in message.columns], strict=True
        ):
            number = _number(described, block.values[rows, column])
            word |= _bits((number - float(signal.offset)) / float(signal.scale), signal)
        if message.counter is not None:
            counts = self._counts[k] + np.arange(rows.size)
            word |= _bits(counts % (1 << message.counter.length), message.counter)
        self._counts[k] += rows.size
        data = np.zeros((rows.size, MOST_BYTES), dtype=np.uint8)
        data[:, :LONGEST_FRAME] = word.astype("<u8").view(np.uint8).reshape(-1, LONGEST_FRAME)
        t = block.t[rows]
        frames = CanFrames(
            t,
            np.full(t.size, np.nan),
            np.full(t.size, message.id, dtype=np.uint32),
            np.full(t.size, message.length, dtype=np.uint8),
            data,
            np.zeros(t.size, dtype=np.uint8),
        )
        return t, frames


class SerialDevice:
    """A device on a serial port that sends binary frames stamped by its own clock."""

    def __init__(self, source: SerialFrames, clock: DeviceClock) -> None:
        self.name = source.name
        self._fields = source.fields
        self._clock = clock
        self._layout = frame_layout(source.fields)
        self._count = 0

    def encode(self, block: Block) -> tuple[Array, list[bytes]]:
        """The instants (M,) of its samples and the frames that carry them."""
        channels = [field.channel for field in self._fields if field.channel is not None]
        columns = [block.channels.index(channel) for channel in channels]
        rows = np.flatnonzero(~np.isnan(block.values[:, columns]).any(axis=1))
        words = np.zeros(rows.size, dtype=self._layout)
        for k, field in enumerate(self._fields):
            words[f"f{k}"] = self._words(field.type, *self._column(k, block, rows))
        frames = encode_frames(words)
        if self._count == 0 and frames:
            # A reader that was there before then knows the first one to be whole.
            frames[0] = FRAME_END + frames[0]
        self._count += rows.size
        return block.t[rows], frames

    def _column(self, k: int, block: Block, rows: NDArray[np.intp]) -> tuple[Array, float]:
        """Numbers of field k, and what they count modulo; infinity where they do not wrap."""
        field = self._fields[k]
        wrap = float(field.wrap or (2.0 ** int(field.type[1:]) if field.type[0] == "u" else np.inf))
        if field.tick is not None:
            return np.floor(self._clock(block.t[rows]) / field.tick + 0.5), wrap
        if field.counter:
            return self._count + np.arange(rows.size, dtype=np.float64), wrap
        if field.channel is None:
            return np.zeros(rows.size), np.inf
        return (block.values[rows, block.channels.index(field.channel)] - field.offset) / field.scale, np.inf

    @staticmethod
    def _words(kind: str, numbers: Array, wrap: float) -> Array:
        if np.isfinite(wrap):
            numbers = np.mod(numbers, wrap)
        return numbers if kind[0] == "f" else np.rint(numbers)


def _number(signal: Signal, values: Array) -> Array:
    """The device's numbers of channel values."""
    return (values - signal.offset) / signal.scale


def _bits(numbers: Array | Indices, signal: CanSignal) -> NDArray[np.uint64]:
    """Whole numbers where a signal has its bits; beyond its range its end, as of a sensor that saturates."""
    half = 1 << (signal.length - 1)
    low, high = (-half, half - 1) if signal.is_signed else (0, 2 * half - 1)
    whole = np.clip(np.rint(numbers), low, high).astype(np.int64)
    return (whole.view(np.uint64) & np.uint64(2 * half - 1)) << np.uint64(signal.start)


def devices(
    system: System, directory: Path | None, clocks: Sequence[DeviceClock]
) -> tuple[list[CanDevice], list[SerialDevice]]:
    """The devices of a system's sources. clocks: of each. InputError for a source that cannot be simulated."""
    can: list[CanDevice] = []
    serial: list[SerialDevice] = []
    for source, clock in zip(system.sources, clocks, strict=True):
        if isinstance(source, CanSource):
            can.append(CanDevice(source, directory))
        elif isinstance(source, SerialFrames):
            serial.append(SerialDevice(source, clock))
        else:
            expected = "a CAN source with a DBC, or binary frames on a serial port"
            raise InputError(system.name, f"source {source.name}", source.kind, expected)
    return can, serial
