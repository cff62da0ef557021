"""Effects of a diagnosis in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sms_online.grouping import grouped

# Look-alikes that people are shown: more are a sign of weak data, and nobody reads them.
SHOWN = 5


def cells_of(value: Mapping[str, Any]) -> list[str]:
    """A coefficient's estimate, its deviation, empty where it has none, and its unit."""
    std = value["std"]
    if std is not None and not std < abs(value["estimate"]):
        return ["not determined", "", value["unit"]]
    return [f"{value['estimate']:.5g}", "" if std is None else f"{std:.2g}", value["unit"]]


def look_alikes(effect: Mapping[str, Any]) -> str:
    """What these data do not separate an effect from, by kind with its places; empty where nothing."""
    shown = (key.partition("@") for key in effect["ambiguous_with"][:SHOWN])
    places = grouped((name, where) for name, _, where in shown)
    more = len(effect["ambiguous_with"]) - SHOWN
    kinds = [f"{name} at {', '.join(where)}" for name, where in places.items()]
    return "; ".join(kinds) + (f" and {more} more" if more > 0 else "")


def why(effect: Mapping[str, Any]) -> str:
    """Why an effect was found; empty where it was not compared.

    The finding in words, or what it improves of held-out data beside the next best.
    """
    if effect["sentence"]:
        return str(effect["sentence"])
    evidence = effect["evidence"]
    own, other = evidence["held_out_improvement"], evidence["next_held_out_improvement"]
    if own is None:
        return ""
    text = f"{effect['name']}@{effect['where']} lowers the residual of held-out rows by {percent(own)}"
    if other is None:
        return text
    return f"{text}; the next, {evidence['next']}, {f'by {percent(other)}' if other > 0.0 else 'not at all'}"


def percent(share: float) -> str:
    """A share of at most one."""
    return f"{100.0 * min(1.0, max(0.0, share)):.0f} %"
