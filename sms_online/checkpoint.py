"""A session's state as arrays: NumPy's .npz without pickle, so that it can be read anywhere and runs no code."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sms_online.description.parse import describe
from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator, SessionState

# What session a state belongs to: its system and channels, as JSON; and how it was begun.
IDENTITY, BEGUN = "identity", "begun"
# Separates stage and entry in the archive's names.
SEPARATOR = "/"


@dataclass(frozen=True)
class Checkpoint:
    """What a session of the same system and channels needs to go on, bit for bit. source: its name, for messages."""

    arrays: Mapping[str, NDArray[Any]]
    source: str = "saved session"

    @staticmethod
    def of(estimator: Estimator, begun: Mapping[str, Any] | None = None) -> Checkpoint:
        """The state of now, in arrays of its own: the estimator may go on before they are written.

        begun: how the session was begun, as plain JSON types.
        """
        arrays = {
            f"{stage}{SEPARATOR}{key}": np.array(value)
            for stage, entries in estimator.state().items()
            for key, value in entries.items()
        }
        own = {IDENTITY: np.array(_identity(estimator)), BEGUN: np.array(json.dumps(begun or {}))}
        return Checkpoint(own | arrays)

    @property
    def identity(self) -> dict[str, Any]:
        """System and used channels of the session."""
        return self._document(IDENTITY)

    @property
    def begun(self) -> dict[str, Any]:
        """How the session was begun."""
        return self._document(BEGUN)

    def _document(self, name: str) -> dict[str, Any]:
        try:
            document: dict[str, Any] = json.loads(str(self.arrays[name]))
        except (KeyError, ValueError) as error:
            raise self._unusable(error) from None
        return document

    def write(self, file: BinaryIO) -> None:
        """Write it as .npz."""
        np.savez(file, allow_pickle=False, **self.arrays)

    def to_bytes(self) -> bytes:
        """The same in memory."""
        buffer = BytesIO()
        self.write(buffer)
        return buffer.getvalue()

    @staticmethod
    def read(file: BinaryIO, source: str) -> Checkpoint:
        """Read one; InputError where it is none."""
        try:
            with np.load(file, allow_pickle=False) as archive:
                return Checkpoint({name: archive[name] for name in archive.files}, source)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise Checkpoint({}, source)._unusable(error) from error

    def put_into(self, estimator: Estimator) -> None:
        """Have an estimator of the same system and channels go on from here; InputError where it does not fit."""
        state: SessionState = {}
        try:
            if str(self.arrays[IDENTITY]) != _identity(estimator):
                raise ValueError("it belongs to another system or other channels")
            for name in self.arrays.keys() - {IDENTITY, BEGUN}:
                stage, key = name.split(SEPARATOR, 1)
                state.setdefault(stage, {})[key] = self.arrays[name]
            estimator.restore(state)
        except (ValueError, KeyError) as error:
            raise self._unusable(error) from error

    def _unusable(self, error: Exception) -> InputError:
        return InputError(
            self.source, "", f"no usable checkpoint ({error})", "a file saved by a session of this system"
        )


def _identity(estimator: Estimator) -> str:
    return json.dumps({"system": describe(estimator.system), "channels": estimator.channels}, sort_keys=True)
