"""A session's state in a file, complete or not there."""

from __future__ import annotations

import os
from pathlib import Path

from sms_online.checkpoint import Checkpoint
from sms_online.errors import InputError


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; OSError where the disk refuses it."""
    temporary = path.with_name(path.name + ".part")
    with temporary.open("wb") as file:
        checkpoint.write(file)
    os.replace(temporary, path)


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint; InputError where the file is none."""
    try:
        with path.open("rb") as file:
            return Checkpoint.read(file, str(path))
    except OSError as error:
        found = f"no usable checkpoint ({error.strerror or error})"
        raise InputError(str(path), "", found, "a file saved by a session of this system") from None
