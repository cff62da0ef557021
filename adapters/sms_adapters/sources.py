"""A recorded file as a source of blocks, by the ending of its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sms_adapters.can_logs import CSV_HEADER
from sms_adapters.can_replay import CanLogReader
from sms_adapters.capture import CaptureReader
from sms_adapters.lines import LineReader
from sms_adapters.log_bags import is_bag
from sms_adapters.log_reader import LogReader
from sms_adapters.log_tables import ARRAY_ENDINGS, PARQUET_ENDINGS
from sms_adapters.part import Part
from sms_adapters.recording import Recording
from sms_adapters.session_log import SESSION
from sms_online.description.channels import channels
from sms_online.description.schema import System
from sms_online.description.sources import TableSource
from sms_online.errors import InputError
from sms_online.stream import Source

Reader = Callable[[Path, System, Callable[[int], None] | None, Path | None], Source]


def _csv(path: Path, system: System, on_bytes: Callable[[int], None] | None, directory: Path | None) -> Source:
    """A capture, python-can's CAN log, or a table: by the header, and by whether the system describes a table."""
    described = any(isinstance(source, TableSource) for source in system.sources)
    # A table of another program may be in its own encoding: µ and ° in names of columns that nobody asks for.
    header = LineReader(path).first_line(strict=not described).strip()
    if header == CSV_HEADER:
        return CanLogReader(path, system, on_bytes, directory)
    known = channels(system)
    captured = set(header.split(",")) <= {"t", *known}
    if described and not captured:
        return LogReader(path, system, on_bytes)
    return CaptureReader(path, on_bytes, known)


# The reader of a file by the ending of its name. Text may be compressed, with .gz behind.
READERS: dict[str, Reader] = {
    ".csv": _csv,
    **dict.fromkeys((".log", ".asc", ".trc", ".blf", ".mf4"), CanLogReader),
    **dict.fromkeys(
        (*PARQUET_ENDINGS, *ARRAY_ENDINGS), lambda path, system, on_bytes, _: LogReader(path, system, on_bytes)
    ),
}
COMPRESSED = (".csv", ".log", ".asc", ".trc")
NAMES = f"a name ending in {', '.join(READERS)} (or .gz of text), .mcap, .bag or .db3, or a recording"


def is_recorded(path: Path) -> bool:
    """Whether a file or directory is named as one that `open_source` reads."""
    return (path / SESSION).is_file() or is_bag(path) or _reader(path) is not None


def _reader(path: Path) -> Reader | None:
    """The reader of a file that is no bag."""
    plain = Path(path.name.removesuffix(".gz"))
    return READERS.get(plain.suffix) if plain.suffix in COMPRESSED or plain.name == path.name else None


def open_source(
    path: Path,
    system: System,
    start: float | None = None,
    stop: float | None = None,
    on_bytes: Callable[[int], None] | None = None,
    directory: Path | None = None,
) -> Source:
    """The reader of a capture (.csv), a CAN log (.log of candump, .asc, .blf, .trc, .mf4, .csv of python-can), a table
    (.csv, .parquet, .h5, .mat), a bag (.bag, .db3, .mcap or its directory) or a live session's recording (directory).

    A .csv is a capture where its header says so, or the system has no source of kind `table`. start, stop: the part
    that is read, s after the file's first sample, or after the source's own `origin` where it states one.
    on_bytes: called with the bytes of the file consumed so far. directory: where the system file lies, to find its
    DBC. Raises InputError for another ending, a channel that the system does not have, and as the readers do.
    """
    source = _whole(path, system, on_bytes, directory)
    if start is stop is None:
        return source
    return Part(source, str(path), start, stop, getattr(source, "origin", None))


def _whole(path: Path, system: System, on_bytes: Callable[[int], None] | None, directory: Path | None) -> Source:
    """The reader of all of a file."""
    if (path / SESSION).is_file():
        return Recording(path, system, directory, on_bytes)
    if is_bag(path):
        return LogReader(path, system, on_bytes)
    reader = _reader(path)
    if reader is None:
        if path.is_dir():
            expected = "that of a ROS 2 bag, with its metadata.yaml, or of a recording, or a file"
            raise InputError(str(path), "", "a folder that holds neither bag nor recording", expected)
        raise InputError(str(path), "", f"a file named {path.name}", NAMES)
    return reader(path, system, on_bytes, directory)
