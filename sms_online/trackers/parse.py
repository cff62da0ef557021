"""A tracker in one line, as the command line and Python take it."""

from __future__ import annotations

from typing import get_args

from sms_online.description.explain import hint, nearest
from sms_online.description.schema import Drift, Forgetting, TrackerChoice
from sms_online.errors import InputError
from sms_online.trackers.build import KINDS, kinds

# As the site, the command line and messages say it.
GRAMMAR = "rls, rls:forgetting=KIND,memory=SECONDS or kalman:drift=KIND,PARAMETER=KIND/STD,share=NUMBER"


def parse_tracker(text: str) -> TrackerChoice:
    """A tracker from a text such as "rls:forgetting=exponential,memory=5" or "kalman:joint_1.stiffness=learned".

    A drift may have its process noise behind a slash: "kalman:joint_1.stiffness=random_walk/20". InputError otherwise.
    """
    kind, _, options = text.partition(":")
    if kind not in KINDS:
        raise InputError("--tracker", text, repr(kind), kinds(kind))
    chosen: dict[str, object] = {"kind": kind}
    drifts: dict[str, str] = {}
    std: dict[str, float] = {}
    for option in filter(None, options.split(",")):
        key, _, value = option.partition("=")
        if key in ("memory", "share"):
            chosen[key] = _number(text, option, value)
        elif key == "forgetting" and kind == "rls":
            chosen[key] = _one_of(text, option, value, get_args(Forgetting))
        elif kind != "rls" and value:
            drift, slash, noise = value.partition("/")
            drifts["*" if key == "drift" else key] = _one_of(text, option, drift, get_args(Drift))
            if slash:
                std["*" if key == "drift" else key] = _number(text, option, noise)
        else:
            raise InputError("--tracker", text, repr(option), GRAMMAR)
    if drifts:
        chosen["drift"] = drifts["*"] if list(drifts) == ["*"] else drifts
    return TrackerChoice.model_validate(chosen | {"std": std})


def _number(text: str, option: str, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = -1.0
    if not 0.0 < number < float("inf"):
        raise InputError("--tracker", text, repr(option), "a number greater than 0")
    return number


def _one_of(text: str, option: str, value: str, names: tuple[str, ...]) -> str:
    if value not in names:
        raise InputError("--tracker", text, repr(option), f"one of {', '.join(names)}{hint(nearest(value, names))}")
    return value
