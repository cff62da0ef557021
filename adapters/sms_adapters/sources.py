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

    A .csv is a capture where its header says so, or the system has no source of kind `table`. Text may be compressed
    (.gz). start, stop: the part that is read, s after the file's first sample or frame, or the session's start.
    on_bytes: called with the bytes of the file consumed so far. directory: where the system file lies, to find its
    DBC. Raises InputError for another ending, a channel that the system does not have, and as the readers do.
    """
    source, origin = _whole(path, system, on_bytes, directory)
    return source if start is stop is None else Part(source, str(path), start, stop, origin)


def _whole(
    path: Path, system: System, on_bytes: Callable[[int], None] | None, directory: Path | None
) -> tuple[Source, float | None]:
    """The reader of all of a file, and the time that a part of it counts from; None for that of the first sample."""
    if (path / SESSION).is_file():
        recording = Recording(path, system, directory)
        return recording, recording.start
    name = path.name.removesuffix(".gz")
    if is_bag(path) or path.suffix in (*PARQUET_ENDINGS, *ARRAY_ENDINGS):
        return LogReader(path, system, on_bytes), None
    if name.endswith(".csv") and (header := LineReader(path).first_line().strip()) != CSV_HEADER:
        known = channels(system)
        captured = set(header.split(",")) <= {"t", *known}
        if not captured and any(isinstance(source, TableSource) for source in system.sources):
            return LogReader(path, system, on_bytes), None
        return CaptureReader(path, on_bytes, known), None
    if name.endswith((".csv", ".log", ".asc", ".trc")) or path.suffix in (".blf", ".mf4"):
        return CanLogReader(path, system, on_bytes, directory), 0.0
    text, binary = ".csv, .log, .asc, .trc (or .gz of those)", ".blf, .mf4, .parquet, .h5, .mat, .mcap, .bag or .db3"
    expected = f"a name ending in {text}, {binary}, or a recording"
    raise InputError(str(path), "", f"a file named {path.name}", expected)
