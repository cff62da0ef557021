"""From a choice in the system file to a tracker of rows: names to columns, seconds to rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sms_online.description.explain import hint, nearest
from sms_online.description.schema import Drift, TrackerChoice
from sms_online.errors import InputError
from sms_online.grouping import grouped
from sms_online.model.parameters import Parameter
from sms_online.stream import Array, Mask
from sms_online.trackers.drift import LearnedTrend
from sms_online.trackers.forgetting import Directional, Exponential, Forgetting, NoForgetting, SlidingWindow
from sms_online.trackers.interface import Prior, Tracker
from sms_online.trackers.random_walk import RandomWalk
from sms_online.trackers.square_root import RecursiveLeastSquares

# Bodies whose inertial parameters drift together, as propellant leaves them.
TOGETHER = ("spacecraft", "payload")
# Every parameter, as a name in a table.
ALL = "*"
Value = TypeVar("Value")


@dataclass(frozen=True)
class Tracked:
    """What a tracker is built for.

    parameters (n,): columns behind those of nuisances. prior: of nuisances and parameters (m + n,), where something is
    known beforehand; scaled: its scale follows the rows', see `RecursiveLeastSquares`. rows_per_second: of the balance.
    source: name of the system, for messages. rows_a_look: from one look whether all is determined to the next.
    """

    parameters: Sequence[Parameter]
    nuisances: int
    prior: Prior
    scaled: bool
    rows_per_second: float
    source: str
    rows_a_look: int

    @property
    def n(self) -> int:
        """Columns of its rows."""
        return self.nuisances + len(self.parameters)


def check_trackers(choices: Sequence[TrackerChoice], source: str) -> None:
    """InputError for a kind of tracker that there is not, and for one that is chosen twice."""
    for k, choice in enumerate(choices):
        if choice.kind not in KINDS:
            raise InputError(source, "tracker.kind", repr(choice.kind), kinds(choice.kind))
        if choice in choices[:k]:
            raise InputError(source, "tracker", f"{choice.label}, twice", "trackers that differ")


def build_tracker(choice: TrackerChoice, tracked: Tracked) -> Tracker:
    """The empty tracker of a choice; InputError where it does not fit the system's parameters."""
    check_trackers([choice], tracked.source)
    return KINDS[choice.kind](choice, tracked)


def kinds(given: str) -> str:
    """What is expected in place of a kind that is none."""
    return f"one of {', '.join(KINDS)}{hint(nearest(given, list(KINDS)))}"


def build_watch(tracked: Tracked) -> LearnedTrend:
    """A watch that follows no drift, and reports where rows show one."""
    nothing = np.zeros(tracked.n)
    groups = _groups(["learned"] * len(tracked.parameters), tracked)
    return LearnedTrend(tracked.n, groups, nothing, nothing, tracked.prior, follow=False)


def _least_squares(choice: TrackerChoice, tracked: Tracked) -> Tracker:
    if choice.drift != "none" or choice.std or choice.share is not None:
        raise InputError(tracked.source, _place(choice), "a drift of rls", 'kind = "kalman", or a forgetting')
    if (choice.forgetting == "none") != (choice.memory is None):
        found = "no memory" if choice.memory is None else f"a memory of {choice.memory:g} s and no forgetting"
        raise InputError(tracked.source, _place(choice), found, "forgetting and its memory in s, or neither")
    forgetting = _forgetting(choice, tracked.rows_per_second)
    return RecursiveLeastSquares(tracked.n, forgetting, tracked.prior, tracked.scaled)


def _kalman(choice: TrackerChoice, tracked: Tracked) -> Tracker:
    if choice.forgetting != "none" or choice.memory is not None:
        raise InputError(tracked.source, _place(choice), "a forgetting of kalman", 'kind = "rls", or a drift')
    drifts = drifts_of(choice, tracked.parameters, tracked.source)
    std = process_std(choice, tracked, drifts)
    if not {"trend", "learned"} & set(drifts):
        return RandomWalk(tracked.n, std, tracked.prior, tracked.rows_a_look)
    trends = np.where(_columns(drifts, "trend", tracked.nuisances), std, 0.0)
    walks = np.where(_columns(drifts, "random_walk", tracked.nuisances), std, 0.0)
    return LearnedTrend(tracked.n, _groups(drifts, tracked), trends, walks, tracked.prior)


# Every tracker that a system file and the command line can choose, by its kind.
KINDS: dict[str, Callable[[TrackerChoice, Tracked], Tracker]] = {"rls": _least_squares, "kalman": _kalman}


def drifts_of(choice: TrackerChoice, parameters: Sequence[Parameter], source: str) -> list[Drift]:
    """The drift of each parameter; InputError for names that the system does not have. source: its name."""
    table: Mapping[str, Drift] = {ALL: choice.drift} if isinstance(choice.drift, str) else choice.drift
    return [_of(p.name, table, "none") for p in _named(parameters, source, _place(choice, "drift"), table)]


def process_std(choice: TrackerChoice, tracked: Tracked, drifts: Sequence[Drift]) -> Array:
    """Process noise (m + n,) of walks and trends, 0 of all else.

    InputError where a walk or trend states none, and where one is stated that nothing uses.
    """
    out = np.zeros(tracked.nuisances + len(drifts))
    if (choice.std or choice.share is not None) and not {"random_walk", "trend"} & set(drifts):
        found = "a process noise, and no drift that has one"
        raise InputError(tracked.source, _place(choice), found, "random_walk or trend beside std or share")
    parameters = _named(tracked.parameters, tracked.source, _place(choice, "std"), choice.std)
    for k, (p, drift) in enumerate(zip(parameters, drifts, strict=True), start=tracked.nuisances):
        if drift not in ("random_walk", "trend"):
            continue
        shared = None if choice.share is None or not p.nominal else choice.share * abs(p.nominal)
        std = _of(p.name, choice.std, shared)
        if std is None:
            found = f"{drift} of {p.name} without std"
            expected = "std of this parameter" + ("" if choice.share is None else ", whose stated value is zero")
            raise InputError(tracked.source, _place(choice), found, f"{expected}, or share of the stated values")
        out[k] = std
    return out


def _place(choice: TrackerChoice, key: str = "") -> str:
    """Where a message finds a choice, wherever it was made."""
    return f"tracker {choice.label}" + (f", {key}" if key else "")


def _columns(drifts: Sequence[Drift], kind: Drift, nuisances: int) -> Mask:
    """Columns (m + n,) of parameters of one kind of drift."""
    return np.concatenate((np.zeros(nuisances, dtype=np.bool_), [drift == kind for drift in drifts]))


def _groups(drifts: Sequence[Drift], tracked: Tracked) -> list[tuple[int, ...]]:
    """Columns that are learned: one each, but a body's inertial parameters, which its mass moves together."""
    places = enumerate(zip(tracked.parameters, drifts, strict=True), start=tracked.nuisances)
    learned = ((p.owner if p.owner in TOGETHER else p.name, k) for k, (p, drift) in places if drift == "learned")
    return [tuple(columns) for columns in grouped(learned).values()]


def _forgetting(choice: TrackerChoice, rows_per_second: float) -> Forgetting:
    if choice.memory is None:
        return NoForgetting()
    rows = choice.memory * rows_per_second
    if choice.forgetting == "window":
        return SlidingWindow(max(1, round(rows)))
    factor = float(np.exp(-1.0 / rows))
    return Exponential(factor) if choice.forgetting == "exponential" else Directional(factor)


def _named(
    parameters: Sequence[Parameter], source: str, place: str, table: Mapping[str, object]
) -> Sequence[Parameter]:
    """The parameters; InputError where the table names something else."""
    names = [p.name for p in parameters]
    owners = [name.rsplit(".", 1)[0] for name in names]
    for key in table:
        if key not in (*names, *owners, ALL):
            near = nearest(key, [*names, *owners])
            raise InputError(source, place, repr(key), "an estimated parameter" + hint(near))
    return parameters


def _of(name: str, table: Mapping[str, Value], default: Value) -> Value:
    """A parameter's entry: its own, that of what owns it, that of all, or the default."""
    owner = name.rsplit(".", 1)[0]
    return next((table[key] for key in (name, owner, ALL) if key in table), default)
