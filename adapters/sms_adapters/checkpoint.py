"""A session's state in a file: NumPy's .npz without pickle, so that it can be read anywhere and runs no code."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np

from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator, SessionState

# Separates stage and entry in the archive's names.
SEPARATOR = "/"


def save_checkpoint(path: Path, estimator: Estimator) -> None:
    """Write an estimator's state; the file is complete or not there."""
    arrays = {
        f"{stage}{SEPARATOR}{key}": np.asarray(value)
        for stage, entries in estimator.state().items()
        for key, value in entries.items()
    }
    temporary = path.with_name(path.name + ".part")
    with temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    os.replace(temporary, path)


def load_checkpoint(path: Path, estimator: Estimator) -> None:
    """Put a saved state into an estimator of the same system and channels; InputError where the file does not fit."""
    state: SessionState = {}
    try:
        with np.load(path, allow_pickle=False) as archive:
            for name in archive.files:
                stage, key = name.split(SEPARATOR, 1)
                state.setdefault(stage, {})[key] = archive[name]
        estimator.restore(state)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(
            str(path), "", f"no usable checkpoint ({error})", "a file saved by a session of this system"
        ) from error
