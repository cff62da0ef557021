"""A session's state in a file: NumPy's .npz without pickle, so that it can be read anywhere and runs no code."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_online.description.parse import describe
from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator, SessionState

# What session a state belongs to: its system and channels, as JSON.
IDENTITY = "identity"
# Separates stage and entry in the archive's names.
SEPARATOR = "/"


def snapshot(estimator: Estimator) -> dict[str, NDArray[Any]]:
    """An estimator's state now, as arrays of their own: the estimator may go on before they are written."""
    arrays = {
        f"{stage}{SEPARATOR}{key}": np.array(value)
        for stage, entries in estimator.state().items()
        for key, value in entries.items()
    }
    return {IDENTITY: np.array(_identity(estimator))} | arrays


def write_checkpoint(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write a `snapshot`; the file is complete or not there."""
    temporary = path.with_name(path.name + ".part")
    with temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    os.replace(temporary, path)


def load_checkpoint(path: Path, estimator: Estimator) -> None:
    """Put a saved state into an estimator of the same system and channels; InputError where the file does not fit."""
    state: SessionState = {}
    try:
        with np.load(path, allow_pickle=False) as archive:
            if str(archive[IDENTITY]) != _identity(estimator):
                raise ValueError("it belongs to another system or other channels")
            for name in set(archive.files) - {IDENTITY}:
                stage, key = name.split(SEPARATOR, 1)
                state.setdefault(stage, {})[key] = archive[name]
        estimator.restore(state)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(
            str(path), "", f"no usable checkpoint ({error})", "a file saved by a session of this system"
        ) from error


def _identity(estimator: Estimator) -> str:
    return json.dumps({"system": describe(estimator.system), "channels": estimator.channels}, sort_keys=True)
