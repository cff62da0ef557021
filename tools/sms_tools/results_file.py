"""DIR/results.json: where it goes, and that it is there as a whole or not at all."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory

from sms_adapters.files import write_text
from sms_adapters.recorder import being_recorded
from sms_adapters.runs import NAME
from sms_online.errors import InputError

RUNS = Path("runs")


def results_directory(out: Path | None) -> Path:
    """The directory asked for, or a new name in runs/; it is made when results are written.

    Raises InputError where it cannot be made, or a running session records into it, before a long session has run for
    nothing.
    """
    directory = _new_run() if out is None else out
    existing = next(path for path in (directory, *directory.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise InputError(str(directory), "", f"{existing} is no directory", "a directory that can be made")
    if being_recorded(directory):
        raise InputError(str(directory), "", "the folder of a session that runs", "another directory")
    try:
        # Trying shows more than permissions do: of a disk that is full or read-only, and to root.
        with TemporaryDirectory(prefix=".sms-online-", dir=existing) as tried:
            (Path(tried) / NAME).write_text("tried\n", encoding="utf-8")
    except OSError as error:
        found = f"nothing can be written in {existing}: {error.strerror or error}"
        raise InputError(str(directory), "", found, "a directory that can be made") from None
    return directory


def _new_run() -> Path:
    name = f"{datetime.now():%Y-%m-%d-%H%M%S}"
    run, count = RUNS / name, 1
    while run.exists():
        count += 1
        run = RUNS / f"{name}-{count}"
    return run


def write_document(path: Path, text: str) -> Path:
    """Write the text of a document, see `write_text`, and end its last line."""
    return write_text(path, text + "\n")
