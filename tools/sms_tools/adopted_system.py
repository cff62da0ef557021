"""The system file of a rig with the effects that a diagnosis has found: the file as it was, and what comes to it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from difflib import ndiff
from typing import Any

from sms_adapters.system_file import system_text
from sms_online.description.schema import Fitted, System
from sms_tools.found_effects import cells_of

# Beside a recording, which holds the described system as system.toml.
ONLINE_NAME = "adopted.toml"
# The table of fitted values, or that of one of them.
FITTED = re.compile(r"\s*\[fitted[\].]")
# A table of a tracker.
TRACKER = re.compile(r"\s*\[\[?tracker[\].]")


def adopted_text(described: str, before: System, after: System, remarks: Mapping[str, str]) -> str:
    """TOML of the system `after`: the text of `described`, file or name of the system `before`, and what is new.

    remarks: what to say of an effect, by name@where, for people.
    """
    lines = system_text(described).rstrip().splitlines()
    if after.gravity != before.gravity:
        stated = [k for k, line in enumerate(lines) if re.match(r"\s*gravity\s*=", line)]
        new, old = (", ".join(f"{g:.9g}" for g in each.gravity) for each in (after, before))
        gravity = f"gravity = [{new}] # m/s², found; the file said [{old}]"
        if stated:
            lines[stated[0]] = gravity
        else:
            first_table = next((k for k, line in enumerate(lines) if line.startswith("[")), len(lines))
            lines[first_table:first_table] = [gravity, ""]
    for i, (joint, found) in enumerate(zip(before.joints, after.joints, strict=True), start=1):
        if joint.gear_ratio != found.gear_ratio:
            said = f"gear_ratio = {found.gear_ratio:.4g} # found; the file said {joint.gear_ratio:g}"
            _state(lines, f"joint_{i}", said)
    for effect in after.effects:
        if effect not in before.effects:
            lines += ["", "[[effect]]", f'name = "{effect.name}"', f'where = "{effect.where}"']
            if effect.coefficients:
                inside = ", ".join(f"{name} = {value:.9g}" for name, value in effect.coefficients.items())
                lines.append(f"coefficients = {{ {inside} }}")
            if effect.over is not None:
                lines.append(f'over = "{effect.over}"')
                lines.append(f"knots = [{', '.join(f'{knot:.9g}' for knot in effect.knots)}]")
            if remark := remarks.get(effect.key):
                lines.append(f"# found: {remark}")
    if after.trackers != before.trackers:
        _remove_tables(lines, TRACKER)
        (learned,) = after.trackers
        lines += ["", "[tracker] # of parameters that drift", f'kind = "{learned.kind}"', f'drift = "{learned.drift}"']
    if after.fitted != before.fitted:
        _state_fitted(lines, after.fitted)
    return "\n".join(lines) + "\n"


def _state(lines: list[str], table: str, statement: str) -> None:
    """Put a statement in place of that of the same key in a table of TOML lines."""
    begin = lines.index(f"[{table}]")
    key = statement.split()[0]
    for k in range(begin + 1, len(lines)):
        if lines[k].startswith("["):
            break
        if re.match(rf"\s*{key}\s*=", lines[k]):
            lines[k] = statement
            return
    lines.insert(begin + 1, statement)


def _state_fitted(lines: list[str], fitted: Mapping[str, Fitted]) -> None:
    """Put a table [fitted] at the end of TOML lines, in place of what they hold of one."""
    _remove_tables(lines, FITTED)
    lines += ["", "[fitted] # nominal values from here on; with --prior, priors of these standard deviations"]
    for name, found in fitted.items():
        std = "" if found.std is None else f", std = {found.std:.3g}"
        lines.append(f'"{name}" = {{ value = {found.value:.9g}{std} }}')


def _remove_tables(lines: list[str], heading: re.Pattern[str]) -> None:
    """Remove the tables of TOML lines whose headings match."""
    while (begin := next((k for k, line in enumerate(lines) if heading.match(line)), None)) is not None:
        end = next((k for k in range(begin + 1, len(lines)) if lines[k].lstrip().startswith("[")), len(lines))
        del lines[begin:end]


def remarks(effects: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """What was found of effects, as a document has them: a line of text each, by name@where; the first counts."""
    out: dict[str, str] = {}
    for effect in effects:
        values = (" ".join((name, *_cells(value))) for name, value in effect["coefficients"].items())
        out.setdefault(f"{effect['name']}@{effect['where']}", ", ".join(values))
    return out


def _cells(value: Mapping[str, Any]) -> list[str]:
    estimate, std, unit = cells_of(value)
    return [estimate, *([f"± {std}"] if std else []), *([unit] if unit else [])]


def added_lines(described: str, adopted: str) -> list[str]:
    """Lines of the TOML `adopted` that the text of `described`, file or name of a system, does not hold."""
    pairs = ndiff(system_text(described).rstrip().splitlines(), adopted.splitlines())
    return [line[2:] for line in pairs if line.startswith("+ ")]
