"""What the estimator's process hands to the view's process, in order of time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sms_online.pipeline.statistics import Statistics
from sms_online.stream import Block
from sms_online.verdict.evidence import Discrepancy
from sms_online.verdict.trust import Trust
from sms_tools.view.choice import Choice


class TroubleError(Exception):
    """The view cannot go on; says why."""


@dataclass(frozen=True)
class Reference:
    """What a parameter is compared with: its true value (of a simulation) or the description's nominal one."""

    value: float
    is_true: bool


@dataclass(frozen=True)
class Diagnosed:
    """A diagnosis made before the session is shown: verdict and evidence are in front.

    parameters: estimate and standard deviation by name, to be shown in place of the session's; empty where those are
    the same. trust: of the diagnosis.
    """

    parameters: Mapping[str, tuple[float, float]]
    trust: Trust


@dataclass(frozen=True)
class Circumstances:
    """What the trust in a session takes from beside its estimator: see `verdict.evidence.Evidence`."""

    discrepancies: tuple[Discrepancy, ...] = ()
    troubles: tuple[str, ...] = ()


@dataclass(frozen=True)
class Start:
    """The session before any sample, the channels of its blocks, a reference for each parameter.

    recording: file that `save` writes. exaggeration: factor on every deflection drawn. live: the source states its
    latency and clocks. diagnosed: of a session that is shown once more.
    """

    statistics: Statistics
    channels: tuple[str, ...]
    choice: Choice
    recording: Path
    references: tuple[Reference | None, ...]
    exaggeration: float
    live: bool
    diagnosed: Diagnosed | None


@dataclass(frozen=True)
class Picture:
    """Samples since the last picture; where due also what the estimator knows behind them.

    health: of a live source, see `session.Health`. wall: s, of the process's own clock.
    """

    blocks: tuple[Block, ...]
    state: Statistics | None
    health: Mapping[str, Mapping[str, float]]
    circumstances: Circumstances
    wall: float
    dropped: int


@dataclass(frozen=True)
class Event:
    """Something to be marked in every plot and named in the log."""

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
    state: Statistics
    circumstances: Circumstances


Frame = Start | Picture | Event | Evidence | End
