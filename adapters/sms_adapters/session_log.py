"""The files of a recording: what every device delivered, raw, with the session's times, readable by other tools.

    session.toml        schema, epoch, sources, and at the end how the session ended
    system.toml         the system file, where there is one
    <source>.log        CAN frames as `candump -l` writes them; the interface is the source's name
    <source>.serial     `(<seconds>) <source> <bytes in hexadecimal>`, a line for each read
    <source>.udp        the same, a line for each datagram
    <source>.stamps     one whole number a frame, µs: the stamp of the interface, where there are stamps; - is none
    <source>.dropped    `first count`: items, counted from 0, that the estimator was too slow for

Times are UTC in whole µs: the session's epoch plus the arrival on its monotonic clock.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, repeat
from pathlib import Path
from typing import Any

import numpy as np

from sms_adapters.candump import parsed
from sms_adapters.files import reading
from sms_adapters.lines import LineReader
from sms_adapters.raw import ERROR_FRAME, EXTENDED, FD_FRAME, REMOTE_FRAME, CanFrames, Raw, SerialChunk
from sms_online.description.schema import TrackerChoice
from sms_online.description.sources import Recorded
from sms_online.errors import InputError
from sms_online.stream import Array, Mask

SCHEMA = "sms-online/recording/1"
# Number of the rules by which raw items become rows: ticks, clocks, portions. A recording made under others replays
# with slightly other times of the samples. Recordings without a number were made under the first ones.
RULES = 4
SESSION = "session.toml"
SYSTEM = "system.toml"
CHECKPOINT = "resumed-from.msgpack"
SUFFIXES: dict[Recorded, str] = {"can": ".log", "serial": ".serial", "udp": ".udp"}
STAMPS, DROPPED = ".stamps", ".dropped"
MICROSECOND = 1e-6
# Bit of a candump identifier that marks an error frame (CAN_ERR_FLAG of linux/can.h), written with eight digits.
_ERROR_ID = 0x2000_0000
_NO_STAMP = b"-"


def to_microseconds(t: float) -> int:
    """Whole µs of a time on the session's clock."""
    return round(t / MICROSECOND)


def from_microseconds(count: int) -> float:
    """The time of so many µs; every arrival is one of these, so that a recording holds it exactly."""
    return count * MICROSECOND


@dataclass(frozen=True)
class SessionHeader:
    """The contents of session.toml at the session's start.

    epoch: UTC of the session's clock zero, µs. sources: name to kind, in the order of the system file. start: time of
    the clock's zero in the estimate, s; not 0 where the session resumed an earlier one. versions: of programs, by name.
    rules: see RULES. trackers: those that were asked for in place of the system file's, none where nothing was.
    """

    epoch: int
    sources: dict[str, Recorded]
    start: float
    versions: dict[str, str]
    rules: int = RULES
    trackers: tuple[TrackerChoice, ...] = ()


def header_text(header: SessionHeader) -> str:
    """session.toml of a session that begins."""
    lines = [f'schema = "{SCHEMA}"', f"epoch_us = {header.epoch}", f"start_s = {header.start!r}"]
    trackers = [each.model_dump_json() for each in header.trackers]
    lines += [f"rules = {header.rules}", *([f"trackers = {json.dumps(trackers)}"] if trackers else []), "", "[sources]"]
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
    with reading(path, "a recording's session.toml"):
        text = path.read_text(encoding="utf-8")
    try:
        document = tomllib.loads(text)
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
            tuple(TrackerChoice.model_validate_json(text) for text in document.get("trackers", [])),
        )
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
    return ["-\n" if np.isnan(t) else f"{to_microseconds(t)}\n" for t in frames.stamp.tolist()]


def chunk_line(name: str, epoch: int, chunk: SerialChunk) -> str:
    """The line of <source>.serial or .udp for what was read at once."""
    seconds, micro = divmod(epoch + to_microseconds(chunk.arrival), 1_000_000)
    return f"({seconds}.{micro:06d}) {name} {chunk.data.hex()}\n"


class RecordedItems:
    """The raw items of one source of a recording, in order of arrival, without those the estimator never saw.

    on_bytes: called with each file of them and its bytes consumed so far. Raises InputError for a line that is none.
    """

    def __init__(
        self,
        directory: Path,
        name: str,
        kind: Recorded,
        epoch: int,
        on_bytes: Callable[[Path, int], None] = lambda path, count: None,
    ) -> None:
        self.path = directory / (name + SUFFIXES[kind])
        stamps = directory / (name + STAMPS)
        self._kind = kind
        self._epoch = epoch
        self._lines = LineReader(self.path, partial(on_bytes, self.path))
        self._stamp_lines = LineReader(stamps, partial(on_bytes, stamps))
        self._dropped = _ranges(directory / (name + DROPPED))

    @property
    def cut(self) -> bool:
        """Whether the last line had no end (a kill), and was left out."""
        return self._lines.cut_line is not None or self._stamp_lines.cut_line is not None

    def __iter__(self) -> Iterator[Raw]:
        stamps = self._stamps()
        before = 0
        for line, text in _whole_lines(self._lines):
            if self._kind != "can":
                chunks = [self._chunk(line + k, each) for k, each in enumerate(bytes(text).decode().splitlines())]
                yield from (chunk for chunk, used in zip(chunks, self._used(before, len(chunks)), strict=True) if used)
                before += len(chunks)
            else:
                times, frames, _ = parsed(self.path, line, text, {})
                stamp = np.array(list(islice(stamps, len(frames))), dtype=np.float64)
                frames, times = frames[: stamp.size], times[: stamp.size]  # a kill may have cost the last stamps
                arrival = (times // 1000 - self._epoch).astype(np.float64) * MICROSECOND
                used = self._used(before, len(frames))
                if used.any():
                    yield replace(frames, arrival=arrival, stamp=stamp)[used]
                before += len(frames)

    def _used(self, before: int, count: int) -> Mask:
        """Which of the items (count,), after so many before them, were not dropped."""
        used = np.ones(count, dtype=np.bool_)
        for first, dropped in self._dropped:
            used[max(0, first - before) : max(0, first + dropped - before)] = False
        return used

    def _stamps(self) -> Iterator[float]:
        """The stamp of each frame, s, NaN where there is none."""
        if not self._stamp_lines.path.is_file():
            yield from repeat(np.nan)
        for _, text in _whole_lines(self._stamp_lines):
            for word in bytes(text).split():
                yield np.nan if word == _NO_STAMP else from_microseconds(int(word))

    def _chunk(self, number: int, line: str) -> SerialChunk:
        try:
            time, _, payload = line.split(" ")
            seconds, _, micro = time[1:-1].partition(".")
            arrival = from_microseconds(int(seconds) * 1_000_000 + int(micro) - self._epoch)
            return SerialChunk(arrival, bytes.fromhex(payload))
        except (ValueError, IndexError):
            expected = "a line as the recorder writes it"
            raise InputError(str(self.path), f"line {number}", repr(line[:60]), expected) from None


def _whole_lines(reader: LineReader) -> Iterator[tuple[int, memoryview]]:
    """See `LineReader`; a file that is not there, or empty, has none, for nothing ever came."""
    return iter(reader) if reader.path.is_file() and reader.path.stat().st_size else iter(())


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
