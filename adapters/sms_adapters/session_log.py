"""The files of a recording: what every device delivered, raw, with the session's times, readable by other tools.

    session.toml        schema, epoch, sources, and at the end how the session ended
    system.toml         the system file, where there is one
    <source>.log        CAN frames as `candump -l` writes them; the interface is the source's name
    <source>.serial     `(<seconds>) <source> <bytes in hexadecimal>`, a line for each read
    <source>.stamps     one whole number a frame, µs: the stamp of the interface, where there are stamps; - is none
    <source>.dropped    `first count`: items, counted from 0, that the estimator was too slow for

Times are UTC in whole µs: the session's epoch plus the arrival on its monotonic clock.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sms_adapters.raw import ERROR_FRAME, EXTENDED, FD_FRAME, MOST_BYTES, REMOTE_FRAME, CanFrames, Raw, SerialChunk
from sms_online.errors import InputError
from sms_online.stream import Array

SCHEMA = "sms-online/recording/1"
# Number of the rules by which raw items become rows: ticks, clocks, portions. A recording made under others replays
# with slightly other times of the samples. Recordings without a number were made under the first ones.
RULES = 3
SESSION = "session.toml"
SYSTEM = "system.toml"
CHECKPOINT = "resumed-from.msgpack"
SUFFIXES: dict[str, str] = {"can": ".log", "serial": ".serial"}
STAMPS, DROPPED = ".stamps", ".dropped"
MICROSECOND = 1e-6
# Bit of a candump identifier that marks an error frame (CAN_ERR_FLAG of linux/can.h), written with eight digits.
_ERROR_ID = 0x2000_0000
_EXTENDED_DIGITS = 8
_NO_STAMP = "-"
# Frames of one piece when a recording is read: a third of a second of a busy bus.
_AT_ONCE = 1024
_NEVER = 1 << 62

Kind = Literal["can", "serial"]
# arrival s, stamp s, identifier, length, data, flags
_Frame = tuple[float, float, int, int, bytes, int]


def to_microseconds(t: float) -> int:
    """Whole µs of a time on the session's clock."""
    return round(t / MICROSECOND)


def from_microseconds(count: int) -> float:
    """The time of so many µs; every arrival is one of these, so that a recording holds it exactly."""
    return count * MICROSECOND


@dataclass(frozen=True)
class SessionHeader:
    """What session.toml says at the session's start.

    epoch: UTC of the session's clock zero, µs. sources: name to kind, in the order of the system file. start: time of
    the clock's zero in the estimate, s; not 0 where the session resumed an earlier one. versions: of programs, by name.
    rules: see RULES.
    """

    epoch: int
    sources: dict[str, Kind]
    start: float
    versions: dict[str, str]
    rules: int = RULES


def header_text(header: SessionHeader) -> str:
    """session.toml of a session that begins."""
    lines = [f'schema = "{SCHEMA}"', f"epoch_us = {header.epoch}", f"start_s = {header.start!r}"]
    lines += [f"rules = {header.rules}", "", "[sources]"]
    lines += [f'{name} = "{kind}"' for name, kind in header.sources.items()]
    lines += ["", "[versions]", *(f"{json.dumps(name)} = {json.dumps(text)}" for name, text in header.versions.items())]
    return "\n".join(lines) + "\n"


def ending_text(duration: float, unrecorded: int, warnings: Sequence[str]) -> str:
    """What is added to session.toml at the end: length, s, items that could not be written, what went wrong."""
    # A TOML string is written as a JSON one.
    noted = json.dumps(list(warnings), ensure_ascii=False)
    return f"\n[end]\nduration_s = {duration!r}\nunrecorded = {unrecorded}\nwarnings = {noted}\n"


def read_header(directory: Path) -> tuple[SessionHeader, dict[str, Any] | None]:
    """The header of a recording and its ending, None after a kill; InputError where it is no recording."""
    path = directory / SESSION
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
        if document["schema"] != SCHEMA:
            raise ValueError(f"schema {document['schema']!r}")
        if not set(document["sources"].values()) <= set(SUFFIXES):
            raise ValueError("a source of unknown kind")
        header = SessionHeader(
            int(document["epoch_us"]),
            dict(document["sources"]),
            float(document["start_s"]),
            document["versions"],
            int(document.get("rules", 1)),
        )
    except OSError as error:
        raise InputError(str(path), "", error.strerror or str(error), "a recording's session.toml") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(str(path), "", f"{error}", f"a document of schema {SCHEMA}") from None
    return header, document.get("end")


def frame_lines(name: str, epoch: int, frames: CanFrames) -> list[str]:
    """candump's lines of frames."""
    lines = []
    for arrival, id_, length, data, flags in zip(
        frames.arrival.tolist(),
        frames.id.tolist(),
        frames.length.tolist(),
        frames.data,
        frames.flags.tolist(),
        strict=True,
    ):
        seconds, micro = divmod(epoch + to_microseconds(arrival), 1_000_000)
        word = f"{id_ & ~EXTENDED:08X}" if id_ & EXTENDED else f"{id_:03X}"
        if flags & ERROR_FRAME:
            word = f"{id_ & ~EXTENDED | _ERROR_ID:08X}"
        payload = data[:length].tobytes().hex().upper()
        if flags & REMOTE_FRAME:
            payload = f"R{length}"
        elif flags & FD_FRAME:
            payload = f"#0{payload}"
        lines.append(f"({seconds}.{micro:06d}) {name} {word}#{payload}\n")
    return lines


def stamp_lines(frames: CanFrames) -> list[str]:
    """Lines of <source>.stamps."""
    return [_NO_STAMP + "\n" if np.isnan(t) else f"{to_microseconds(t)}\n" for t in frames.stamp.tolist()]


def chunk_line(name: str, epoch: int, chunk: SerialChunk) -> str:
    """The line of <source>.serial for what was read at once."""
    seconds, micro = divmod(epoch + to_microseconds(chunk.arrival), 1_000_000)
    return f"({seconds}.{micro:06d}) {name} {chunk.data.hex()}\n"


class RecordedItems:
    """The raw items of one source of a recording, in order of arrival, without those the estimator never saw.

    cut: the last line had no end (a kill), and was left out. Raises InputError for a line that is none.
    """

    def __init__(self, directory: Path, name: str, kind: Kind, epoch: int) -> None:
        self.path = directory / (name + SUFFIXES[kind])
        self.cut = False
        self._kind = kind
        self._epoch = epoch
        self._stamps = directory / (name + STAMPS)
        self._dropped = _ranges(directory / (name + DROPPED))

    def __iter__(self) -> Iterator[Raw]:
        dropped = iter([*self._dropped, (_NEVER, 0)])
        first, count = next(dropped)
        frames: list[_Frame] = []
        for number, (line, stamp) in enumerate(zip(self._lines(self.path), self._stamp_lines(), strict=False)):
            while number >= first + count:
                first, count = next(dropped)
            if number >= first:
                continue
            try:
                if self._kind == "serial":
                    yield self._chunk(line)
                else:
                    frames.append(self._frame(line, stamp))
            except (ValueError, IndexError):
                expected = "a line as the recorder writes it"
                raise InputError(str(self.path), f"line {number + 1}", repr(line[:60]), expected) from None
            if len(frames) == _AT_ONCE:
                yield _as_arrays(frames)
                frames = []
        if frames:
            yield _as_arrays(frames)

    def _lines(self, path: Path) -> Iterator[str]:
        """Whole lines; a file that is not there has none, for nothing ever came."""
        if not path.is_file():
            return
        with path.open(encoding="ascii", errors="replace") as file:
            for line in file:
                if not line.endswith("\n"):
                    self.cut = True
                    return
                yield line[:-1]

    def _stamp_lines(self) -> Iterator[str]:
        return self._lines(self._stamps) if self._stamps.is_file() else repeat(_NO_STAMP)

    def _arrival(self, time: str) -> float:
        seconds, _, micro = time[1:-1].partition(".")
        return from_microseconds(int(seconds) * 1_000_000 + int(micro) - self._epoch)

    def _chunk(self, line: str) -> SerialChunk:
        time, _, payload = line.split(" ")
        return SerialChunk(self._arrival(time), bytes.fromhex(payload))

    def _frame(self, line: str, stamp: str) -> _Frame:
        time, _, text = line.split(" ")
        word, _, payload = text.partition("#")
        id_, flags = int(word, 16), 0
        if len(word) == _EXTENDED_DIGITS:
            id_, flags = (id_ & ~_ERROR_ID, ERROR_FRAME) if id_ & _ERROR_ID else (id_ | EXTENDED, 0)
        data = b""
        if payload.startswith("R"):
            flags |= REMOTE_FRAME
            length = int(payload[1:])
        else:
            if payload.startswith("#"):
                flags |= FD_FRAME
                payload = payload[2:]
            data = bytes.fromhex(payload)
            length = len(data)
        stamped = np.nan if stamp == _NO_STAMP else from_microseconds(int(stamp))
        return self._arrival(time), stamped, id_, length, data.ljust(MOST_BYTES, b"\0"), flags


def _as_arrays(frames: list[_Frame]) -> CanFrames:
    arrival, stamp, id_, length, data, flags = zip(*frames, strict=True)
    return CanFrames(
        np.array(arrival),
        np.array(stamp),
        np.array(id_, dtype=np.uint32),
        np.array(length, dtype=np.uint8),
        np.frombuffer(b"".join(data), np.uint8).reshape(-1, MOST_BYTES),
        np.array(flags, dtype=np.uint8),
    )


def _ranges(path: Path) -> list[tuple[int, int]]:
    if not path.is_file():
        return []
    lines = path.read_text(encoding="ascii").splitlines()
    return [(int(first), int(count)) for first, count in (line.split() for line in lines if line.count(" ") == 1)]


def quantised(frames: CanFrames, not_before: float) -> CanFrames:
    """Frames with arrivals of at least `not_before`; these and stamps in whole µs, as a recording holds them."""
    arrival: Array = np.rint(frames.arrival / MICROSECOND) * MICROSECOND
    stamp: Array = np.rint(frames.stamp / MICROSECOND) * MICROSECOND
    return replace(frames, arrival=np.maximum(arrival, not_before), stamp=stamp)


def number_of_items(items: Iterable[Raw]) -> int:
    """How many lines these are in a recording: frames, or chunks."""
    return sum(len(item) if isinstance(item, CanFrames) else 1 for item in items)
