"""CAN logs that python-can reads: Vector's .asc and .blf, PEAK's .trc, its own .csv, and .mf4 of ASAM."""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO, TextIO, cast

import can
import numpy as np

from sms_adapters.can_reader import frames_of
from sms_adapters.candump import LoggedFrames
from sms_adapters.files import reading
from sms_adapters.lines import READABLE, LineLog, LineReader
from sms_adapters.raw import MOST_BYTES, CanFrames, one_line
from sms_online.errors import InputError

# Frames turned into arrays at once.
_CHUNK = 16384
_MOST_ID = (1 << 29) - 1
# Most that zlib can have compressed, and the least bytes of an object in a .blf.
_EXPANSION, _OBJECT = 1032, 16
CSV_HEADER = "timestamp,arbitration_id,extended,remote,error,dlc,data"


class TextLog(LineLog):
    """A log of lines, .asc, .trc or .csv, each also as .gz; iterations start from its beginning.

    Lines that hold no frame are passed over, as python-can does. Raises InputError for a line that cannot be read, a
    time that goes back, and times that are intervals.
    """

    def __init__(self, path: Path, on_bytes: Callable[[int], None] | None = None) -> None:
        super().__init__(path, on_bytes)
        self._ending = Path(path.name.removesuffix(".gz")).suffix

    def __iter__(self) -> Iterator[LoggedFrames]:
        """The frames, some thousands at a time."""
        text = _Lines(self._lines)
        reader: can.io.generic.MessageReader
        if self._ending == ".asc":
            # Times of day, for a log may have several blocks that each begin at 0.
            reader = can.ASCReader(cast(TextIO, text), relative_timestamp=False)
        else:
            reader = (can.TRCReader if self._ending == ".trc" else can.CSVReader)(cast(TextIO, text))
        try:
            for part in _arrays(self._path, reader, lambda _: f"line {text.number}"):
                self._check_times(reader)
                yield part
        except InputError:
            self._check_times(reader)
            raise
        finally:
            reader.stop()

    def _check_times(self, reader: can.io.generic.MessageReader) -> None:
        """InputError for a log whose times are intervals, which its reader takes for times."""
        if isinstance(reader, can.ASCReader) and reader.timestamps_format == "relative":
            raise InputError(str(self._path), "header", "timestamps relative", "a log with absolute timestamps")


class BinaryLog:
    """A binary log, .blf or .mf4 (extra `mf4`); iterations start from its beginning.

    A .blf that ends early is read as far as it goes, and warned of. Raises InputError where it is damaged.
    """

    def __init__(self, path: Path, on_bytes: Callable[[int], None] | None = None) -> None:
        self._path = path
        self._on_bytes = on_bytes
        self._cut = ""

    @property
    def warnings(self) -> list[str]:
        """Warnings of what is missing at the end, as far as the file shows it."""
        return [f"{self._path.name}: its end is missing, {self._cut}"] if self._cut else []

    def __iter__(self) -> Iterator[LoggedFrames]:
        """The frames, some thousands at a time."""
        self._cut = ""
        with reading(self._path, READABLE):
            file = self._path.open("rb")
        with file:
            reader = self._reader(file)
            size = self._path.stat().st_size
            count = 0
            for part in _arrays(self._path, reader, lambda n: f"frame {n + 1}"):
                count += len(part.frames)
                if count > size * _EXPANSION / _OBJECT:
                    # A damaged size of 0 makes python-can read one object of a .blf for ever.
                    raise InputError(str(self._path), "", "more frames than it has room for", "a log without damage")
                if self._on_bytes is not None:
                    self._on_bytes(size if file.closed else file.tell())  # its reader closes it at the end
                yield part
        if isinstance(reader, can.BLFReader):
            if size < reader.file_size:
                self._cut = f"{size} bytes of {reader.file_size} are there"
            elif count and not reader.object_count:
                self._cut = "it was never closed"

    def _reader(self, file: BinaryIO) -> can.io.generic.MessageReader:
        try:
            return can.BLFReader(file) if self._path.suffix == ".blf" else can.MF4Reader(file)
        except NotImplementedError:
            expected = "it: pip install 'sms-online[mf4]'"
            raise InputError(str(self._path), "", "the package asammdf is not installed", expected) from None
        # Of a file that is no such log, the readers raise whatever comes first.
        except Exception as error:
            raise InputError(str(self._path), "", one_line(error), f"a {self._path.suffix} log") from None


class _Lines(io.TextIOBase):
    """Whole lines as the text file that python-can's readers want; `number` is that of the last line given."""

    def __init__(self, reader: LineReader) -> None:
        self.number = 0
        # Names and comments may be in any encoding; frames are ASCII.
        self._texts = (text for _, chunk in reader for text in bytes(chunk).decode("utf-8", "replace").split("\n")[:-1])

    def __next__(self) -> str:  # type: ignore[override]  # of io's classes only those of text are such iterators
        text = next(self._texts)
        self.number += 1
        return text + "\n"


def _arrays(path: Path, reader: can.io.generic.MessageReader, place: Callable[[int], str]) -> Iterator[LoggedFrames]:
    """The frames of a reader, times from 0 on; place: where a frame is, from the number of those before it."""
    messages = iter(reader)
    first: float | None = None
    last = -np.inf
    count = 0
    buses: dict[str, int] = {}
    while True:
        batch: list[can.Message] = []
        broken: InputError | None = None
        try:
            batch.extend(islice(messages, _CHUNK))
        except InputError:
            raise
        except struct.error:
            pass  # a .blf that ends within the header of an object
        # What the readers raise of a bad line or object is not theirs but Python's: ValueError, IndexError, KeyError …
        except Exception as error:
            broken = InputError(str(path), place(count + len(batch)), one_line(error), f"a {path.suffix} log")
        if batch:
            _check_possible(path, batch, count)
            t = np.array([message.timestamp for message in batch])
            back = np.flatnonzero(~(np.diff(t, prepend=last) >= 0))
            if back.size:
                found, expected = "a time before that of the frame above", "times that do not go back"
                raise InputError(str(path), f"frame {count + int(back[0]) + 1}", found, expected)
            first, last = (float(t[0]) if first is None else first), float(t[-1])
            count += len(batch)
            bus = [buses.setdefault(str(message.channel), len(buses)) for message in batch]
            frames = frames_of(batch, t - first)
            timed = CanFrames(t - first, t - first, frames.id, frames.length, frames.data, frames.flags)
            yield LoggedFrames(timed, np.array(bus, dtype=np.intp), tuple(buses))
        if broken is not None:
            raise broken
        if len(batch) < _CHUNK:
            return


def _check_possible(path: Path, batch: list[can.Message], before: int) -> None:
    """InputError at the first of the messages that no CAN bus can have carried; the readers do not look."""
    for k, message in enumerate(batch):
        if not 0 <= message.arbitration_id <= _MOST_ID or not math.isfinite(message.timestamp):
            found = f"identifier {message.arbitration_id:X} at {message.timestamp} s"
        elif len(message.data) > MOST_BYTES or (message.is_remote_frame and not 0 <= message.dlc <= MOST_BYTES):
            found = f"a frame of {max(len(message.data), message.dlc)} bytes"
        else:
            continue
        raise InputError(str(path), f"frame {before + k + 1}", found, "what a CAN bus can carry")
