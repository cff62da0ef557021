"""The reference of system files, made of the schema: tables, keys, types, defaults, and the docstrings' lines."""

from __future__ import annotations

import inspect
import re
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, MinLen
from markdown.extensions.toc import slugify
from pydantic.fields import FieldInfo

from sms_online.description import schema, sources
from sms_online.description.parse import RENAMED
from sms_online.description.record import Record
from sms_online.description.schema import System

# Heading of each record's section; `System` comes first, the others in this order.
HEADINGS: dict[type[Record], str] = {
    schema.System: "Top level",
    schema.Spacecraft: "`[spacecraft]`",
    schema.Joint: "`[joint_i]`",
    schema.FixedJoint: '`[joint_i]` of `kind = "fixed"`',
    schema.Motor: "`[motor_i]`",
    schema.RigidLink: '`[link_i]` of `kind = "rigid"`',
    schema.FlexibleLink: '`[link_i]` of `kind = "flexible"`',
    schema.RigidBody: "`[payload]`",
    schema.Inertia: "Inertias",
    schema.Sensor: "`[[sensor]]`",
    schema.Effect: "`[[effect]]`",
    schema.Prior: "`[prior]`",
    schema.Controller: "`[controller]`",
    schema.Trajectory: "`[trajectory]`",
    schema.Harmonic: "Harmonics of a trajectory",
    schema.Windows: "`[windows]`",
    schema.Tolerances: "`[tolerances]`",
    schema.TrackerChoice: "`[tracker]`",
    sources.CanSource: '`[[source]]` of `kind = "can"`',
    sources.CanopenSource: '`[[source]]` of `kind = "canopen"`',
    sources.SerialFrames: '`[[source]]` of `kind = "serial"` and `format = "frames"`',
    sources.SerialLines: '`[[source]]` of `kind = "serial"` and `format = "lines"`',
    sources.TableSource: '`[[source]]` of `kind = "table"`',
    sources.BagSource: '`[[source]]` of `kind = "bag"`',
    sources.Signal: "Signals of a CAN source",
    sources.FrameField: "Fields of binary frames",
    sources.SerialField: "Fields of lines",
    sources.LogSignal: "Signals of a log",
}
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
        for inner in _records(field.annotation):
            found |= _reachable(inner)
    return found


def _records(annotation: Any) -> list[type[Record]]:
    if isinstance(annotation, type) and issubclass(annotation, Record):
        return [annotation]
    return [record for part in get_args(annotation) for record in _records(part)]


def _section(record: type[Record], heading: str) -> str:
    about, fields = described_fields(record)
    lines = [f"## {heading}", "", about, ""]
    lines += ["| key | value | default | meaning |", "|---|---|---|---|"]
    tables = {field: key for key, field in RENAMED.items()}
    for name, field in record.model_fields.items():
        key = tables.get(name, name) if record is System else name
        lines.append(f"| `{key}` | {_type(field)} | {_default(field)} | {_cell(fields[name])} |")
    return "\n".join([*lines, ""])


def _cell(text: str) -> str:
    """Text for a cell of a table."""
    return text.replace("|", "\\|")


def _type(field: FieldInfo) -> str:
    return _named(field.annotation, field.metadata)


def _named(annotation: Any, limits: list[Any]) -> str:
    """An annotation in words."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _named(inner[0], [*inner[1:], *limits])
    if origin in (Union, UnionType):
        parts = [_named(part, []) for part in inner if part is not NoneType]
        return " or ".join(dict.fromkeys(parts))
    if origin is Literal:
        return " or ".join(f"`{value!r}`".replace("'", '"') for value in inner)
    if origin is tuple:
        if inner[-1] is Ellipsis:
            return f"list of {_named(inner[0], [])}" + (", not empty" if _has(limits, MinLen) else "")
        return f"{len(inner)} numbers"
    if origin is dict:
        return f"table of {_named(inner[1], [])}"
    if isinstance(annotation, type) and issubclass(annotation, Record):
        heading = HEADINGS[annotation].replace("`", "")
        return f"[{annotation.__name__}](#{slugify(heading, '-')})"
    return _limited({float: "number", int: "whole number", str: "text", bool: "true or false"}[annotation], limits)


def _limited(text: str, limits: list[Any]) -> str:
    for limit in _flat(limits):
        if isinstance(limit, Gt):
            text += f" > {limit.gt}"
        if isinstance(limit, Ge):
            text += f" ≥ {limit.ge}"
    return text


def _has(limits: list[Any], kind: type) -> bool:
    return any(isinstance(limit, kind) for limit in _flat(limits))


def _flat(limits: list[Any]) -> list[Any]:
    """Limits, those within a `Field(…)` too."""
    return [limit for each in limits for limit in (each.metadata if isinstance(each, FieldInfo) else [each])]


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.default
    if value is None or value == () or value == {}:
        return "none"
    if isinstance(value, Record) or (isinstance(value, tuple) and isinstance(value[0], Record)):
        return "its defaults"
    text = {True: "true", False: "false"}.get(value) if isinstance(value, bool) else None
    if isinstance(value, tuple):
        text = f"[{', '.join(f'{each:g}' for each in value)}]"
    if isinstance(value, str):
        text = f'"{value}"'
    return f"`{text if text is not None else format(value, 'g')}`"
