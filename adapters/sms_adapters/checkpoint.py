"""A session's state in a file, complete or not there."""

from __future__ import annotations

from pathlib import Path

from sms_adapters.files import part_of
from sms_online.checkpoint import EXPECTED, Checkpoint
from sms_online.errors import InputError


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; OSError where the disk refuses it."""
    part = part_of(path)
    part.write_bytes(checkpoint.to_bytes())
    part.replace(path)


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint; InputError where the file is none."""
    try:
        return Checkpoint.from_bytes(path.read_bytes(), str(path))
    except OSError as error:
        found = f"no usable checkpoint ({error.strerror or error})"
        raise InputError(str(path), "", found, EXPECTED) from None
