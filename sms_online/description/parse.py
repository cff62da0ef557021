"""From the text of a system file (TOML) to a checked `System`, and the texts that are shipped with the package.

Tables of a file: [spacecraft], then [joint_i], [motor_i] (optional) and [link_i] for i = 1..N, those of fixed joints
last, [payload], [[sensor]], [[source]], [[effect]], [known], [prior], [fitted], [controller], [trajectory],
[windows], [tolerances], [tracker]; keys are the fields of `schema`.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from pydantic import ValidationError

from sms_online.description.check import check_system
from sms_online.description.explain import explain, unknown_key
from sms_online.description.schema import System
from sms_online.errors import InputError

# Top-level keys of a file and the field of `System` that each fills; numbered tables come beside them.
PLAIN = (
    "name", "title", "reference", "motion", "gravity", "sample_rate", "balance", "spacecraft", "payload", "known",
    "fitted",
)  # fmt: skip
RENAMED = {
    "wrench": "wrenches", "sensor": "sensors", "source": "sources", "effect": "effects", "prior": "priors",
    "tracker": "trackers",
}  # fmt: skip
WITHOUT_NUMBERS = (*PLAIN, *RENAMED, "controller", "trajectory", "windows", "tolerances")
NUMBERED = re.compile(r"(joint|motor|link)_([1-9]\d*)")
# Levels of tables and lists in a file: one more than a signal of a source or a harmonic of a joint needs.
DEPTH = 6
SYNTAX_ERROR_PLACE = re.compile(r"(?P<what>.*) \(at (?P<place>[^()]*)\)", re.DOTALL)


def parse_system(text: str, source: str) -> System:
    """System described by the TOML `text`; `source` is the file's name in messages.

    Raises InputError, one line with file, table.key, what was found and what was expected.
    """
    try:
        document = tomllib.loads(text)
        depth = _depth(document)
    except RecursionError:
        depth = DEPTH + 1
    except tomllib.TOMLDecodeError as error:
        parts = SYNTAX_ERROR_PLACE.fullmatch(str(error))
        what, place = (parts["what"], parts["place"]) if parts else (str(error), "")
        raise InputError(source, place, " ".join(what.split()), "valid TOML") from None
    except ValueError:  # Python's own limit on the digits of a number
        raise InputError(source, "", "a number of thousands of digits", "valid TOML") from None
    if depth > DEPTH:
        raise InputError(source, "", "tables or lists deep in each other", f"no more than {DEPTH} levels of them")
    return system_of(document, source)


def system_of(document: Mapping[str, Any], source: str) -> System:
    """System of a system file's tables; InputError as `parse_system`."""
    record = _arrange(document, source)
    try:
        # Strict, so that "5" and true are no numbers; by way of JSON, for in Python's strict mode lists are no tuples.
        system = System.model_validate_json(json.dumps(record, default=str), strict=True)
    except ValidationError as error:
        raise explain(error, source) from None
    check_system(system, source)
    return system


def _depth(value: Any) -> int:
    """Levels of tables and lists."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else None
    return 0 if inside is None else 1 + max((_depth(item) for item in inside), default=0)


def _arrange(document: Mapping[str, Any], source: str) -> dict[str, Any]:
    """The document with the field names of `System`; InputError on unknown tables and holes in the numbering."""
    counts = {"joint": 0, "motor": 0, "link": 0}
    for key in document:
        numbered = NUMBERED.fullmatch(key)
        if numbered:
            counts[numbered[1]] = max(counts[numbered[1]], int(numbered[2]))
        elif key not in WITHOUT_NUMBERS:
            known = [f"{kind}_{i}" for kind in counts for i in range(1, max(counts.values()) + 2)]
            raise unknown_key(
                source, key, key, (*WITHOUT_NUMBERS, *known), listed=(*WITHOUT_NUMBERS, "joint_i", "motor_i", "link_i")
            )
    n = max(counts.values())
    if n == 0:
        raise InputError(source, "joint_1", "no such table", "at least one joint: tables [joint_1] and [link_1]")
    for kind in ("joint", "link"):
        for i in range(1, n + 1):
            if f"{kind}_{i}" not in document:
                last = max(
                    (key for key in document if NUMBERED.fullmatch(key)), key=lambda key: int(key.rsplit("_", 1)[1])
                )
                raise InputError(
                    source,
                    f"{kind}_{i}",
                    "no such table",
                    f"joints and links numbered 1 to {n} without holes, since there is [{last}]",
                )
    record = {key: document[key] for key in (*PLAIN, "controller", "windows", "tolerances") if key in document}
    record |= {field: document[key] for key, field in RENAMED.items() if key in document}
    if isinstance(record.get("trackers"), dict):
        record["trackers"] = [record["trackers"]]
    joints = [document[f"joint_{i}"] for i in range(1, n + 1)]
    moving = _moving(joints, document, source)
    record["joints"], record["fixed_joints"] = joints[:moving], joints[moving:]
    record["links"] = [document[f"link_{i}"] for i in range(1, n + 1)]
    record["motors"] = [document.get(f"motor_{i}") for i in range(1, moving + 1)]
    if "trajectory" in document:
        record["trajectory"] = _arrange_trajectory(document["trajectory"], moving, source)
    return record


def _moving(joints: list[Any], document: Mapping[str, Any], source: str) -> int:
    """Number of joints that move; InputError where a fixed one comes before them, or has a motor."""
    for i, joint in enumerate(joints, start=1):
        if isinstance(joint, dict) and isinstance(joint.get("parent"), list):
            found = f"several, {joint['parent']}: a closed chain"
            raise InputError(source, f"joint_{i}.parent", found, "one parent: links and joints make a tree")
    fixed = [isinstance(joint, dict) and joint.get("kind") == "fixed" for joint in joints]
    moving = fixed.index(True) if True in fixed else len(joints)
    if moving == 0:
        raise InputError(source, "joint_1", "a fixed joint, and none that moves", "at least one joint that moves")
    if not all(fixed[moving:]):
        after = moving + fixed[moving:].index(False) + 1
        found = f"a fixed joint before joint_{after}, which moves"
        raise InputError(
            source, f"joint_{moving + 1}", found, "fixed joints numbered last; parent = 'link_i' places them"
        )
    for i in range(moving + 1, len(joints) + 1):
        if f"motor_{i}" in document:
            raise InputError(source, f"motor_{i}", f"a motor at joint_{i}, which is fixed", "no such table")
    return moving


def _arrange_trajectory(table: Any, n: int, source: str) -> Any:
    """The trajectory's joint_i lists as one list `joints`."""
    if not isinstance(table, dict):
        return table
    names = [f"joint_{i}" for i in range(1, n + 1)]
    for key in table:
        if key not in ("duration", *names):
            raise unknown_key(source, f"trajectory.{key}", key, ("duration", *names))
    for name in names:
        if name not in table:
            raise InputError(source, f"trajectory.{name}", "missing", f"a list of harmonics for each of the {n} joints")
    out = {"joints": [table[name] for name in names]}
    return out | ({"duration": table["duration"]} if "duration" in table else {})


def shipped_systems() -> tuple[str, ...]:
    """Names of the systems that are shipped with the package, in alphabetical order."""
    folder = files("sms_online.description") / "systems"
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml")))


def shipped_text(name: str) -> str:
    """Text of a shipped system file; InputError on any other name."""
    if name not in shipped_systems():
        raise InputError(name, "", "no shipped system of this name", f"one of {', '.join(shipped_systems())}")
    return (files("sms_online.description") / "systems" / f"{name}.toml").read_text(encoding="utf-8")


def describe(system: System) -> dict[str, Any]:
    """The whole resolved description, defaults included, as plain JSON types: `system` of results.json."""
    return system.model_dump(mode="json")
