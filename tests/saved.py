"""Stages that go on from what others have saved."""

from __future__ import annotations

from typing import TypeVar

from sms_online.state import Stage, collect, encode, put_back

StageT = TypeVar("StageT", bound=Stage)


def resumed(fresh: StageT, before: Stage) -> StageT:
    """A fresh stage, made with the same arguments, with the state of another."""
    put_back(fresh, encode(collect(before)))
    return fresh
