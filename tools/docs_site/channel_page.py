"""The channels that captures of the shipped systems may hold."""

from __future__ import annotations

import re

from sms_online.description.channels import channels
from sms_online.description.parse import parse_system, shipped_systems, shipped_text
from sms_online.grouping import grouped


def channel_tables() -> str:
    """A row for each shipped system."""
    lines = ["| system | channels |", "|---|---|"]
    for name in shipped_systems():
        names = channels(parse_system(shipped_text(name), name))
        lines.append(f"| `{name}` | {', '.join(f'`{each}`' for each in _folded(names))} |")
    return "\n".join(lines)


def _folded(names: tuple[str, ...]) -> list[str]:
    """Names that differ in their numbers alone as one: link_1…2.marker_1…2.u_y."""
    groups = grouped((re.sub(r"\d+", "#", name), re.findall(r"\d+", name)) for name in names)
    out = []
    for text, numbers in groups.items():
        for column in zip(*numbers, strict=True):
            text = text.replace("#", _span(sorted(map(int, set(column)))), 1)
        out.append(text)
    return out


def _span(numbers: list[int]) -> str:
    """1…3 for 1, 2, 3; a list where some are missing."""
    first, last = numbers[0], numbers[-1]
    if len(numbers) > 1 and numbers == list(range(first, last + 1)):
        return f"{first}…{last}"
    return ",".join(map(str, numbers))
