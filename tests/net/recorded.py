"""The file of recorded numbers: a line a place, lists of numbers in one line, and nothing twice."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

from tests.net.numbers import Numbers, Value, differences

PATH = Path(__file__).with_name("recorded.json")
ELEMENT = re.compile(r"(.*)\[(\d+)\]")
WHOLE, CONTINUED = "whole.", "continued."

# Numbers as the file holds them: a list in place of its elements.
Packed = dict[str, Value | list[Value]]


@dataclass(frozen=True)
class Recorded:
    """Where numbers were recorded, and those of each session."""

    environment: dict[str, str]
    sessions: dict[str, Numbers]

    @staticmethod
    def read() -> Recorded:
        """What the file holds."""
        document = json.loads(PATH.read_text())
        return Recorded(document["environment"], {name: unpacked(each) for name, each in document["sessions"].items()})

    def write(self) -> None:
        """Put it in the file."""
        sessions = [f"{json.dumps(name)}: {_lines(packed(found))}" for name, found in self.sessions.items()]
        text = f'{{\n"environment": {_lines({**self.environment})},\n"sessions": {{\n'
        PATH.write_text(text + ",\n".join(sessions) + "\n}\n}\n")


def _lines(members: Packed) -> str:
    return "{\n" + ",\n".join(f"{json.dumps(path)}: {json.dumps(value)}" for path, value in members.items()) + "\n}"


def packed(found: Numbers) -> Packed:
    """Numbers with their lists together, and without the continued session where it gives those of the whole one."""
    if not any(differences(_part(found, WHOLE), _part(found, CONTINUED), 0.0)):
        found = {path: value for path, value in found.items() if not path.startswith(CONTINUED)}
    out: Packed = {}
    for path, value in found.items():
        element = ELEMENT.fullmatch(path)
        if element is None:
            out[path] = value
            continue
        values = out.setdefault(element[1], [])
        assert isinstance(values, list)
        assert len(values) == int(element[2])
        values.append(value)
    return out


def unpacked(held: Packed) -> Numbers:
    """The numbers that `packed` was made of."""
    out: Numbers = {}
    for path, value in held.items():
        out |= {f"{path}[{k}]": each for k, each in enumerate(value)} if isinstance(value, list) else {path: value}
    if not _part(out, CONTINUED):
        out |= {CONTINUED + path: value for path, value in _part(out, WHOLE).items()}
    return out


def _part(found: Numbers, run: str) -> Numbers:
    return {path.removeprefix(run): value for path, value in found.items() if path.startswith(run)}
