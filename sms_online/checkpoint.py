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
from sms_online.state import encode, put_back

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
    """What is written: the head and the estimator's encoded states."""

    head: Head
    estimator: bytes


class _Versioned(msgspec.Struct):
    """As much of a file as is the same in all versions."""

    version: str


class _AnyFile(msgspec.Struct):
    head: _Versioned


@dataclass(frozen=True)
class Checkpoint:
    """What a session of the same system and channels needs to go on, bit for bit. source: its name, for messages."""

    head: Head
    estimator: bytes
    source: str = "saved session"

    @staticmethod
    def of(estimator: Estimator, begun: Mapping[str, Any] | None = None) -> Checkpoint:
        """The state of now; takes milliseconds. begun: how the session was begun, as plain JSON types."""
        head = Head(__version__, describe(estimator.system), estimator.channels, dict(begun or {}))
        return Checkpoint(head, encode(estimator))

    def to_bytes(self) -> bytes:
        """As it is written to files, msgpack."""
        return msgspec.msgpack.encode(_File(self.head, self.estimator))

    @staticmethod
    def from_bytes(data: bytes, source: str) -> Checkpoint:
        """Of `to_bytes`; InputError where it is none, or one of another version."""
        try:
            found = msgspec.msgpack.decode(data, type=_AnyFile).head.version
            if found != __version__:
                raise InputError(source, "", f"a checkpoint of version {found}", f"one of version {__version__}")
            file = msgspec.msgpack.decode(data, type=_File)
        except msgspec.DecodeError as error:
            raise _unusable(source, error) from None
        return Checkpoint(file.head, file.estimator, source)

    def put_into(self, estimator: Estimator) -> None:
        """Have an estimator of the same system and channels go on from here; InputError where it does not fit."""
        here = Head(self.head.version, describe(estimator.system), estimator.channels, self.head.begun)
        if self.head != here:
            raise InputError(self.source, "", *_difference(self.head, here))
        try:
            put_back(estimator, self.estimator)
        except (msgspec.DecodeError, ValueError) as error:
            raise _unusable(self.source, error) from None


def _difference(saved: Head, here: Head) -> tuple[str, str]:
    """What a checkpoint is of, and what it should be of."""
    if saved.channels != here.channels:
        return f"a checkpoint of channels {', '.join(saved.channels)}", ", ".join(here.channels)
    keys = sorted(
        key for key in saved.system.keys() | here.system.keys() if saved.system.get(key) != here.system.get(key)
    )
    names = [head.system.get("name") for head in (saved, here)]
    return f"a checkpoint of system {names[0]}", f"system {names[1]}, which differs in {', '.join(keys)}"


def _unusable(source: str, error: Exception) -> InputError:
    return InputError(source, "", f"no usable checkpoint ({error})", EXPECTED)
