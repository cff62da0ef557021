"""A recorded file as a source of blocks, by the ending of its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sms_adapters.can_logs import CSV_HEADER
from sms_adapters.can_replay import CanLogReader
from sms_adapters.capture import CaptureReader
from sms_adapters.lines import LineReader
from sms_adapters.recording import Recording
from sms_adapters.session_log import SESSION
from sms_online.description.channels import channels
from sms_online.description.schema import System
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
    """The reader of a capture (.csv), a CAN log (.log of candump, .asc, .blf, .trc, .mf4, .csv of python-can) or a live
    session's recording (its directory).

    Text may be compressed (.gz). start, stop: seconds after the file's first sample or frame, or the session's start.
    on_bytes: called with the bytes of the file consumed so far. directory: where the system file stands, to find its
    DBC. Raises InputError for another ending, a channel that the system does not have, and as the readers do.
    """
    if (path / SESSION).is_file():
        return Recording(path, system, directory, start, stop)
    name = path.name.removesuffix(".gz")
    if name.endswith(".csv") and LineReader(path).first_line().strip() != CSV_HEADER:
        return CaptureReader(path, start, stop, on_bytes=on_bytes, known=channels(system))
    if name.endswith((".csv", ".log", ".asc", ".trc")) or path.suffix in (".blf", ".mf4"):
        return CanLogReader(path, system, start, stop, on_bytes=on_bytes, directory=directory)
    expected = "a name ending in .csv, .log, .asc, .trc (or .gz of those), .blf or .mf4, or a recording"
    raise InputError(str(path), "", f"a file named {path.name}", expected)
