"""Validation errors in the words of the system file: one line with table.key, what was found and what was expected."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from sms_online.description import bodies, schema, sources
from sms_online.description.bodies import Marker
from sms_online.description.record import Record, tagged
from sms_online.errors import InputError

# Fields of `System` that are numbered tables, or lists of tables, in the file.
TABLES = {
    "joints": "joint_{}",
    "fixed_joints": "fixed joint {}",
    "motors": "motor_{}",
    "links": "link_{}",
    "wrenches": "wrench {}",
    "sensors": "sensor {}",
    "sources": "source {}",
    "effects": "effect {}",
    "trackers": "tracker {}",
}
RECORDS: dict[str, type[BaseModel]] = {
    "spacecraft": bodies.Spacecraft,
    "payload": bodies.RigidBody,
    "joints": bodies.Joint,
    "fixed_joints": bodies.FixedJoint,
    "motors": bodies.Motor,
    "wrenches": schema.Wrench,
    "sensors": schema.Sensor,
    "effects": schema.Effect,
    "priors": schema.Prior,
    "controller": schema.Controller,
    "trajectory": schema.Harmonic,
    "windows": schema.Windows,
    "tolerances": schema.Tolerances,
    "trackers": schema.TrackerChoice,
}
# Records that a key of the table distinguishes, by its values; a serial source needs two such keys.
LINKS: dict[str, type[BaseModel]] = {
    "rigid": bodies.RigidLink,
    "cross": bodies.RigidLink,
    "flexible": bodies.FlexibleLink,
}
SERIAL: dict[str, type[Record]] = tagged("format", sources.SerialSource)
SOURCES: dict[str, type[Record]] = {
    kind: record for kind, record in tagged("kind", sources.Source).items() if record not in SERIAL.values()
}
TAGS = {"links": {"kind": tuple(LINKS)}, "sources": {"kind": (*SOURCES, "serial"), "format": tuple(SERIAL)}}
INERTIAS = ("inertia", "stator_inertia")
# Longest value that a message repeats; more would not fit a line.
LONGEST_VALUE = 60


def quoted(names: Sequence[str], near: str | None = None) -> str:
    """'a', 'b' or 'c', and the one that was probably meant."""
    words = [repr(name) for name in names]
    text = words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"
    return text + hint(near)


def hint(near: str | None) -> str:
    """The question that suggests a name, if there is one to suggest."""
    return f" (did you mean {near!r}?)" if near else ""


def nearest(word: str, names: Sequence[str]) -> str | None:
    """The name that looks most like a word, if one does."""
    matches = difflib.get_close_matches(word, names, n=1)
    return matches[0] if matches else None


def expected_channel(channel: str, known: Sequence[str]) -> str:
    """What was expected in place of a channel that a system does not have."""
    drive, _, joint = channel.partition("_")
    other = {"tau": "force", "force": "tau"}.get(drive)
    if other is not None and f"{other}_{joint}" in known:
        why = "which has no gear" if other == "force" else "at the motor shaft, before the gear"
        return f"'{other}_{joint}', the drive of joint {joint}, {why}"
    return f"a channel of this system, such as {nearest(channel, known) or known[0]!r}"


def unknown_key(
    source: str, place: str, key: str, known: Sequence[str], listed: Sequence[str] | None = None
) -> InputError:
    """Error for an unknown key; `known` are the keys that are compared with it, `listed` those that are printed."""
    return InputError(source, place, f"unknown key {key!r}", quoted(listed or known, nearest(key, known)))


def explain(error: ValidationError, source: str) -> InputError:
    """The first error in a file's own words; unknown keys first, for a misspelt key also leaves one missing."""
    details = error.errors(include_url=False)
    first = next((d for d in details if d["type"] == "extra_forbidden"), details[0])
    place = _place(first["loc"])
    kind, value, context = first["type"], first["input"], first.get("ctx", {})
    if kind == "extra_forbidden":
        return unknown_key(source, place, str(first["loc"][-1]), _keys_beside(first["loc"]))
    if kind == "missing":
        in_list = isinstance(first["loc"][-1], int)
        if in_list:
            return InputError(source, place.rsplit("[", 1)[0], f"{_shown(value)}", "3 numbers")
        return InputError(source, place, "missing", "a value, for this key has no default")
    if kind in ("union_tag_not_found", "union_tag_invalid"):
        key = context["discriminator"].strip("'")
        tag = value.get(key) if isinstance(value, dict) else None
        tags = TAGS[str(first["loc"][0])][key]
        found = "missing" if tag is None else _shown(tag)
        return InputError(source, f"{place}.{key}", found, quoted(tags, nearest(str(tag), tags)))
    if first["loc"][0] == "sources" and "options" in first["loc"]:
        return InputError(source, place.rsplit(".", 1)[0], _shown(value), "a number, a text in quotes, true or false")
    if first["loc"][0] == "known" and isinstance(value, dict):
        name = f"{first['loc'][1]}.{next(iter(value), 'parameter')}"
        return InputError(source, place, "a table", f'a number; a name with a dot is quoted: "{name}" = value')
    return InputError(source, place, _shown(value), _expected(kind, first, context))


def _expected(kind: str, first: ErrorDetails, context: dict[str, Any]) -> str:
    match kind:
        case "greater_than":
            return f"a number greater than {context['gt']:g}"
        case "greater_than_equal":
            return f"a number not less than {context['ge']:g}"
        case "float_type" | "float_parsing":
            return "a number"
        case "int_type" | "int_from_float" | "int_parsing":
            return "a whole number"
        case "finite_number":
            return "a finite number"
        case "string_type":
            return "a text in quotes"
        case "literal_error":
            allowed = context["expected"].replace(" or ", ", ").replace("'", "").split(", ")
            if first["loc"][0] == "joints" and first["loc"][-1] == "kind":
                allowed.append("fixed")  # a record of its own, which this one was not taken for
            return quoted(allowed, nearest(str(first["input"]), allowed))
        case "too_short":
            return f"at least {context['min_length']} of them"
        case "too_long":
            return f"{context['max_length']} numbers"
        case "bool_type":
            return "true or false"
        case "tuple_type" | "list_type":
            table = TABLES.get(str(first["loc"][0]), "")
            return f"a list of tables [[{table.split()[0]}]]" if len(first["loc"]) == 1 and table else "a list"
        case "model_type" | "model_attributes_type" | "dict_type":
            return "a table"
    return first["msg"]


def _shown(value: Any) -> str:
    """A value as a message repeats it, on one line."""
    if isinstance(value, bool):
        return str(value).lower()
    text = "a table" if isinstance(value, dict) else repr(value)
    return text if len(text) <= LONGEST_VALUE else text[: LONGEST_VALUE - 1] + "…"


def _place(loc: tuple[int | str, ...]) -> str:
    """Place in the file, for instance link_2.length or gravity[0], for a place in `System`."""
    parts = list(loc)
    if parts[0] == "trajectory" and parts[1:2] == ["joints"]:
        parts[1:3] = [f"joint_{int(parts[2]) + 1}"] if len(parts) > 2 else []
    if parts[0] in TABLES and len(parts) > 1:
        parts[: 2 + len(_tags(loc))] = [TABLES[str(parts[0])].format(int(parts[1]) + 1)]
    elif parts[0] in ("priors", "sensors", "sources", "effects"):
        parts[0] = str(parts[0]).removesuffix("s")
    text = str(parts[0])
    for part in parts[1:]:
        text += f"[{part + 1}]" if isinstance(part, int) else f".{part}"
    return text


def _tags(loc: tuple[int | str, ...]) -> tuple[int | str, ...]:
    """The tags that pydantic puts into a place in a union, after the number of the table: of two keys, two."""
    by_key = TAGS.get(str(loc[0]), {}).values()
    count = 0
    while count < len(by_key) and loc[2 + count : 3 + count] and loc[2 + count] in tuple(by_key)[count]:
        count += 1
    return loc[2 : 2 + count]


def _keys_beside(loc: tuple[int | str, ...]) -> tuple[str, ...]:
    """Keys that are allowed in place of the unknown key `loc`."""
    if loc[-2] in INERTIAS:
        record: type[BaseModel] = bodies.Inertia
    elif loc[0] == "links":
        record = Marker if "markers" in loc else LINKS[str(loc[2])]
    elif loc[0] == "sources" and "signals" in loc:
        record = sources.LogSignal if loc[2] in ("table", "bag") else sources.Signal
    elif loc[0] == "sources" and "fields" in loc:
        record = sources.FrameField if "frames" in loc else sources.SerialField
    elif loc[0] == "sources":
        record = (SOURCES | SERIAL)[str(_tags(loc)[-1])]
    else:
        record = RECORDS[str(loc[0])]
    return tuple(record.model_fields)
