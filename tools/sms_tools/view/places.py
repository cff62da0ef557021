"""Where on the arm an effect, a row type or a channel sits."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase

from sms_online.grouping import grouped

# Places that are drawn; a channel's sensor sits at one of them, and where its name does not say, on the base.
PLACE = re.compile(r"base|tip|(joint|link)_\d+")
JOINT_CHANNEL = re.compile(r"(?:q|theta_m|tau|force)_(\d+)")
LINK_CHANNEL = re.compile(r"(link_\d+)\.")


def places_of(where: str, channels: Sequence[str]) -> list[str]:
    """Where an effect is drawn on the arm, `joint_i`, `link_i`, `base` or `tip`: at the sensors of its channels."""
    if PLACE.fullmatch(where):
        return [where]
    return list(dict.fromkeys(_sensor(channel) for channel in channels if fnmatchcase(channel, where)))


def drawn_marks(marks: Mapping[str, str], channels: Sequence[str]) -> dict[str, str]:
    """A judgement's marks at the places that are drawn."""
    drawn = grouped((place, text) for where, text in marks.items() for place in places_of(where, channels))
    return {place: ", ".join(dict.fromkeys(texts)) for place, texts in drawn.items()}


def _sensor(channel: str) -> str:
    if joint := JOINT_CHANNEL.match(channel):
        return f"joint_{joint[1]}"
    link = LINK_CHANNEL.match(channel)
    return link[1] if link else "base"
