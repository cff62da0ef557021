"""A CAN log as a source of blocks, decoded by what the system file says of its CAN sources."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

import numpy as np

from sms_adapters.can_decoder import CanDecoder
from sms_adapters.can_logs import BinaryLog, TextLog
from sms_adapters.candump import CandumpLog, LoggedFrames
from sms_adapters.capture import BLOCK
from sms_adapters.devices import make_can_decoder
from sms_adapters.faults import sentences
from sms_adapters.raw import EXTENDED
from sms_online.description.schema import System
from sms_online.description.sources import CanopenSource, CanSource
from sms_online.errors import InputError
from sms_online.stream import Array, Block

_STANDARD_DIGITS, _EXTENDED_DIGITS = 3, 8


class Log(Protocol):
    """A CAN log: iterations give its frames from the beginning; warnings: what the current one has left out."""

    @property
    def warnings(self) -> list[str]:
        """One sentence each."""

    def __iter__(self) -> Iterator[LoggedFrames]:
        """The frames in order of time."""


def open_log(path: Path, on_bytes: Callable[[int], None] | None = None) -> Log:
    """The log of a name ending in .log, .asc, .trc, .csv (each also .gz), .blf or .mf4."""
    ending = Path(path.name.removesuffix(".gz")).suffix
    if ending == ".log":
        return CandumpLog(path, on_bytes)
    return BinaryLog(path, on_bytes) if ending in (".blf", ".mf4") else TextLog(path, on_bytes)


class CanLogReader:
    """A CAN log as blocks in order of time; each iteration starts from its beginning.

    Each frame of a wanted message gives one sample, NaN in the channels of other messages. t: seconds since the log's
    first frame of any kind. on_bytes: as for CaptureReader. directory: where the system file
    lies, with its DBC or EDS. With several CAN sources, each takes the frames of the interface that is its `channel`.

    What the decoders skip is counted in `warnings`, as is a cut end. Raises InputError, on construction for a system
    without a CAN source and for what does not fit its DBC or EDS; while iterating for what the log's reader cannot
    read, one message on two interfaces, or no sample at all.
    """

    origin = 0.0  # s, of parts: the first frame

    def __init__(
        self,
        path: Path,
        system: System,
        on_bytes: Callable[[int], None] | None = None,
        directory: Path | None = None,
    ) -> None:
        self._sources = [s for s in system.sources if isinstance(s, CanSource | CanopenSource)]
        if not self._sources:
            expected = f"a [[source]] of kind 'can' or 'canopen' in the system {system.name!r}"
            raise InputError(str(path), "", "a CAN log without a DBC", expected)
        self._path = path
        self._directory = directory
        self._decoders = self._new_decoders()
        self._log = open_log(path, on_bytes)

    def _new_decoders(self) -> list[CanDecoder]:
        return [make_can_decoder(source, self._directory) for source in self._sources]

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels of the system's CAN sources, in its order."""
        return tuple(channel for decoder in self._decoders for channel in decoder.channels)

    @property
    def warnings(self) -> list[str]:
        """What the current iteration has skipped so far."""
        found = []
        for source, decoder in zip(self._sources, self._decoders, strict=True):
            name = self._path.name if len(self._sources) == 1 else f"{self._path.name}, {source.name}"
            for sentence in sentences(name, decoder.counters):
                unknown = "no channel comes from their ids" in sentence
                found.append(sentence + (f" ({_shown(decoder)})" if unknown else ""))
        return found + self._log.warnings

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks from the log's beginning."""
        self._decoders = self._new_decoders()
        self._bus_of: dict[int, int] = {}
        channels = self.channels
        rows = 0
        for logged in self._log:
            t, values = self._rows(logged)
            rows += t.size
            yield from Block(t, channels, values).pieces(BLOCK)
        if not rows:
            names = ", ".join(message.name for decoder in self._decoders for message in decoder.messages)
            raise InputError(str(self._path), "", "no samples", f"frames of {names}")

    def _rows(self, logged: LoggedFrames) -> tuple[Array, Array]:
        """Times (M,) and values (M, C) of the samples in some frames, those of all sources in order of time."""
        if len(self._decoders) == 1:
            self._check_buses(logged)
            samples = self._decoders[0].push(logged.frames)
            return samples.t_arrival, samples.values
        times, values, column = [np.empty(0)], [np.empty((0, len(self.channels)))], 0
        for source, decoder in zip(self._sources, self._decoders, strict=True):
            if source.channel in logged.buses:
                samples = decoder.push(logged.frames[logged.bus == logged.buses.index(source.channel)])
                wide = np.full((samples.t_arrival.size, len(self.channels)), np.nan)
                wide[:, column : column + len(decoder.channels)] = samples.values
                times.append(samples.t_arrival)
                values.append(wide)
            column += len(decoder.channels)
        t = np.concatenate(times)
        order = np.argsort(t, kind="stable")
        return t[order], np.concatenate(values)[order]

    def _check_buses(self, logged: LoggedFrames) -> None:
        """InputError where one message comes from two interfaces: two devices that cannot be distinguished."""
        for message in self._decoders[0].messages:
            for bus in np.unique(logged.bus[logged.frames.id == message.id]).tolist():
                first = self._bus_of.setdefault(message.id, bus)
                if bus != first:
                    found = f"{message.name} on {logged.buses[bus]} and {logged.buses[first]}"
                    raise InputError(str(self._path), "", found, "a message on one interface, or a source for each")


def _shown(decoder: CanDecoder) -> str:
    """The first of the unknown identifiers, as candump writes them."""
    return ", ".join(
        f"{id_ & ~EXTENDED:0{_EXTENDED_DIGITS if id_ & EXTENDED else _STANDARD_DIGITS}X}" for id_ in decoder.unknown_ids
    )
