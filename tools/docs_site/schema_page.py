"""The reference of system files, made of the schema: tables, keys, types, defaults, and the docstrings' lines."""

from __future__ import annotations

import inspect
import json
import re
from typing import Any

from markdown.extensions.toc import slugify

from sms_online.description import bodies, schema, sources
from sms_online.description.explain import SERIAL, SOURCES
from sms_online.description.parse import RENAMED
from sms_online.description.record import Record, records_in
from sms_online.description.schema import System

# Heading of each record's section; `System` comes first, the others in this order.
HEADINGS: dict[type[Record], str] = {
    schema.System: "Top level",
    bodies.Spacecraft: "`[spacecraft]`",
    bodies.Joint: "`[joint_i]`",
    bodies.FixedJoint: '`[joint_i]` of `kind = "fixed"`',
    bodies.Motor: "`[motor_i]`",
    bodies.RigidLink: '`[link_i]` of `kind = "rigid"`',
    bodies.FlexibleLink: '`[link_i]` of `kind = "flexible"`',
    bodies.Marker: "`[[link_i.markers]]`",
    bodies.RigidBody: "`[payload]`",
    bodies.Inertia: "Inertias",
    schema.Sensor: "`[[sensor]]`",
    schema.Wrench: "`[[wrench]]`",
    schema.Effect: "`[[effect]]`",
    schema.Prior: "`[prior]`",
    schema.Fitted: "`[fitted]`",
    schema.Controller: "`[controller]`",
    schema.Trajectory: "`[trajectory]`",
    schema.Harmonic: "Harmonics of a trajectory",
    schema.Windows: "`[windows]`",
    schema.Tolerances: "`[tolerances]`",
    schema.TrackerChoice: "`[tracker]`",
    **{record: f'`[[source]]` of `kind = "{kind}"`' for kind, record in SOURCES.items()},
    **{record: f'`[[source]]` of `kind = "serial"` and `format = "{name}"`' for name, record in SERIAL.items()},
    sources.Signal: "Signals of a CAN or UDP source",
    sources.FrameField: "Fields of binary frames",
    sources.SerialField: "Fields of lines",
    sources.LogSignal: "Signals of a log",
}
TYPES = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false"}
ENTRY = re.compile(r"(\w+(?:, \w+)*): (.*)")


def schema_tables() -> str:
    """One section a record of the schema. Raises ValueError where a record has no heading or a field no description."""
    if missing := _reachable(System) - set(HEADINGS):
        raise ValueError(f"no heading for {', '.join(sorted(record.__name__ for record in missing))}")
    return "\n".join(_section(record, heading) for record, heading in HEADINGS.items())


def described_fields(record: type[Record]) -> tuple[str, dict[str, str]]:
    """What a record's docstrings say: of the record, and of each of its fields.

    Raises ValueError where a field is not described, or something that is no field.
    """
    about = ""
    fields: dict[str, str] = {}
    for kind in reversed(record.__mro__):
        if issubclass(kind, Record) and kind is not Record:
            about, own = _entries(kind)
            fields |= own
    if set(fields) != set(record.model_fields):
        differing = ", ".join(sorted(set(fields) ^ set(record.model_fields)))
        raise ValueError(f"docstring of {record.__name__}: a line for each field expected, not so for {differing}")
    return about, {name: fields[name] for name in record.model_fields}


def _entries(record: type[Record]) -> tuple[str, dict[str, str]]:
    """The prose of one docstring, and its lines `field, field: description` with what continues them."""
    prose: list[str] = []
    fields: dict[str, str] = {}
    names: list[str] = []
    for line in (inspect.getdoc(record) or "").splitlines():
        entry = ENTRY.fullmatch(line)
        if entry and all(name in record.model_fields for name in entry[1].split(", ")):
            names = entry[1].split(", ")
            fields |= dict.fromkeys(names, entry[2])
        elif names and line:
            fields |= {name: f"{fields[name]} {line}" for name in names}
        else:
            names = []
            prose.append(line)
    return "\n".join(prose).strip(), fields


def _reachable(record: type[Record]) -> set[type[Record]]:
    """The record and all that its fields hold."""
    found = {record}
    for field in record.model_fields.values():
        for inner in records_in(field.annotation):
            found |= _reachable(inner)
    return found


def _section(record: type[Record], heading: str) -> str:
    about, fields = described_fields(record)
    lines = [f"## {heading}", "", about, ""]
    lines += ["| key | value | default | meaning |", "|---|---|---|---|"]
    tables = {field: key for key, field in RENAMED.items()}
    schema = record.model_json_schema(by_alias=False)
    for name, field in schema["properties"].items():
        key = tables.get(name, name) if record is System else name
        default = "required" if name in schema.get("required", ()) else _default(field.get("default"))
        lines.append(f"| `{key}` | {_value(field)} | {default} | {_cell(fields[name])} |")
    return "\n".join([*lines, ""])


def _cell(text: str) -> str:
    """Text for a cell of a table."""
    return text.replace("|", "\\|")


def _value(field: dict[str, Any]) -> str:
    """What a field of a JSON schema takes, in words."""
    if "$ref" in field:
        name = field["$ref"].rpartition("/")[2]
        heading = next(heading for record, heading in HEADINGS.items() if record.__name__ == name)
        return f"[{name}](#{slugify(heading.replace('`', ''), '-')})"
    if choices := field.get("anyOf") or field.get("oneOf"):
        return " or ".join(dict.fromkeys(_value(each) for each in choices if each.get("type") != "null"))
    if values := field.get("enum") or [field[key] for key in ("const",) if key in field]:
        return " or ".join(f"`{json.dumps(value, ensure_ascii=False)}`" for value in values)
    if field["type"] == "object":
        return f"table of {_value(field['additionalProperties'])}"
    if "prefixItems" in field:
        return f"{len(field['prefixItems'])} numbers"
    if field["type"] == "array":
        return f"list of {_value(field['items'])}" + (", not empty" if field.get("minItems") else "")
    limits = [f" {sign} {field[key]}" for key, sign in (("exclusiveMinimum", ">"), ("minimum", "≥")) if key in field]
    return TYPES[field["type"]] + "".join(limits)


def _default(value: Any) -> str:
    """A default of a JSON schema, as a system file states it."""
    if value in (None, [], {}):
        return "none"
    if isinstance(value, dict) or (isinstance(value, list) and isinstance(value[0], dict)):
        return "its defaults"
    if isinstance(value, list):
        return f"`[{', '.join(f'{each:g}' for each in value)}]`"
    return f"`{json.dumps(value, ensure_ascii=False) if isinstance(value, bool | str) else format(value, 'g')}`"
