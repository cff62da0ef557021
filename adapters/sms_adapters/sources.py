"""A recorded file as a source of blocks, by the ending of its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sms_adapters.candump import CandumpReader
from sms_adapters.capture import CaptureReader
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
    """The reader of a capture (.csv, .csv.gz) or of a candump log (.log, .log.gz).

    start, stop: seconds after the file's first sample or frame. on_bytes: called with the bytes of the file consumed so
    far. directory: where the system file stands, to find its DBC.
    Raises InputError for another ending, a channel that the system does not have, and as the readers do.
    """
    name = path.name.removesuffix(".gz")
    if name.endswith(".csv"):
        return CaptureReader(path, start, stop, on_bytes=on_bytes, known=channels(system))
    if name.endswith(".log"):
        return CandumpReader(path, system, start, stop, on_bytes=on_bytes, directory=directory)
    raise InputError(str(path), "", f"a file named {path.name}", "a name ending in .csv, .csv.gz, .log or .log.gz")
