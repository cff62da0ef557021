"""A session's checkpoint: the states of its stages in one piece, and what session they belong to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from sms_online import __version__
from sms_online.description.parse import describe
from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator
from sms_online.state import Saved, Stage, collect, encode, put_back

EXPECTED = "a checkpoint that a session of this system has saved"


class Head(msgspec.Struct, frozen=True):
    """What session a checkpoint belongs to.

    version: of the program that wrote it. system: as described. channels: those used. begun: how the session was begun.
    """

    version: str
    system: dict[str, Any]
    channels: tuple[str, ...]
    begun: dict[str, Any]


class _File(msgspec.Struct, frozen=True):
    """What is written: the head, and encoded states: of `ESTIMATOR` and, where there are some, of the others."""

    head: Head
    states: dict[str, msgspec.Raw]


class _Versioned(msgspec.Struct):
    """The part of a head that is the same in all versions."""

    version: str


class _AnyFile(msgspec.Struct):
    head: _Versioned


ESTIMATOR, SOURCE, HISTORY = "estimator", "source", "history"


@dataclass(frozen=True)
class Checkpoint:
    """What a session of the same system and channels needs to go on, bit for bit.

    states: of the estimator and, where those keep some, of its source and its history. name: of the file, for messages.
    """

    head: Head
    states: Mapping[str, Saved | msgspec.Raw]
    name: str = "saved session"

    @staticmethod
    def of(
        estimator: Estimator,
        begun: Mapping[str, Any] | None = None,
        source: Stage | None = None,
        history: Stage | None = None,
    ) -> Checkpoint:
        """The state of now, in a fraction of a millisecond: the estimator may go on before it is written.

        begun: how the session was begun, as plain JSON types. source: what its samples come from, where that keeps a
        state. history: of its estimates.
        """
        head = Head(__version__, describe(estimator.system), estimator.channels, dict(begun or {}))
        stages = {ESTIMATOR: estimator, SOURCE: source, HISTORY: history}
        return Checkpoint(head, {name: collect(stage) for name, stage in stages.items() if stage is not None})

    def to_bytes(self) -> bytes:
        """The checkpoint as msgpack, for a file."""
        return encode({"head": self.head, "states": self.states})

    @staticmethod
    def from_bytes(data: bytes, name: str) -> Checkpoint:
        """The checkpoint of `to_bytes`; InputError where it is none, or one of another version."""
        try:
            found = msgspec.msgpack.decode(data, type=_AnyFile).head.version
            if found != __version__:
                raise InputError(name, "", f"a checkpoint of version {found}", f"one of version {__version__}")
            file = msgspec.msgpack.decode(data, type=_File)
        except msgspec.DecodeError as error:
            raise _unusable(name, error) from None
        return Checkpoint(file.head, file.states, name)

    def put_into(self, estimator: Estimator) -> None:
        """Have an estimator of the same system and channels go on from here; InputError where it does not fit."""
        here = Head(self.head.version, describe(estimator.system), estimator.channels, self.head.begun)
        if self.head != here:
            raise InputError(self.name, "", *_difference(self.head, here))
        self._put(ESTIMATOR, estimator)

    def put_beside(self, name: str, stage: Stage) -> None:
        """Have a SOURCE or HISTORY of the same session go on from here, if saved; InputError where it does not fit."""
        if name in self.states:
            self._put(name, stage)

    def _put(self, name: str, stage: Stage) -> None:
        try:
            put_back(stage, encode(self.states[name]))
        except (msgspec.DecodeError, ValueError, KeyError) as error:
            raise _unusable(self.name, error) from None


def _difference(saved: Head, here: Head) -> tuple[str, str]:
    """What a checkpoint is of, and what it should be of."""
    if saved.channels != here.channels:
        return f"a checkpoint of channels {', '.join(saved.channels)}", ", ".join(here.channels)
    keys = sorted(
        key for key in saved.system.keys() | here.system.keys() if saved.system.get(key) != here.system.get(key)
    )
    names = [head.system.get("name") for head in (saved, here)]
    return f"a checkpoint of system {names[0]}", f"system {names[1]}, which differs in {', '.join(keys)}"


def _unusable(name: str, error: Exception) -> InputError:
    return InputError(name, "", f"no usable checkpoint ({error})", EXPECTED)
