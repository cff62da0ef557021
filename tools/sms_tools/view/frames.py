"""What the estimator's process hands to the view's process, in order of time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sms_online.stream import Block
from sms_tools.view.choice import Choice
from sms_tools.view.snapshot import Snapshot


class TroubleError(Exception):
    """The view cannot go on; says why."""


@dataclass(frozen=True)
class Reference:
    """What a parameter is compared with: its true value (of a simulation) or the description's nominal one."""

    value: float
    is_true: bool


@dataclass(frozen=True)
class Start:
    """The session: its estimator before any sample, the channels of its blocks, a reference for each parameter.

    estimator: pickled when the session began, for it goes on working while this waits to be sent. recording: file that
    `save` writes. exaggeration: factor on every deflection drawn.
    """

    estimator: bytes
    channels: tuple[str, ...]
    choice: Choice
    recording: Path
    references: tuple[Reference | None, ...]
    exaggeration: float


@dataclass(frozen=True)
class Picture:
    """Samples since the last picture; where due also what the estimator knows behind them.

    health: further numbers of the source, name with unit to value. wall: s, of the process's own clock.
    """

    blocks: tuple[Block, ...]
    state: Snapshot | None
    health: dict[str, float]
    wall: float
    dropped: int


@dataclass(frozen=True)
class Event:
    """Something to be marked in every plot and told in the log."""

    t: float
    text: str


@dataclass(frozen=True)
class Evidence:
    """Score of each candidate effect, `name@where`, at an instant, s; larger is more evidence."""

    t: float
    scores: dict[str, float]


@dataclass(frozen=True)
class End:
    """No more frames; state: the session's last."""

    t: float
    state: Snapshot


Frame = Start | Picture | Event | Evidence | End
