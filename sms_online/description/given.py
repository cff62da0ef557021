"""A system as people hand it to a function: described, by the name of a shipped one, or by the path of its file."""

from __future__ import annotations

from pathlib import Path

from sms_online.description.schema import System
from sms_online.errors import InputError

Given = System | str | Path


def given_system(system: Given) -> tuple[System, Path | None]:
    """The system, and the folder of its file, where a log finds its DBC; None where no file was given.

    Raises InputError where there is no such system, its file cannot be read, or it is something else altogether.
    """
    if isinstance(system, System):
        return system, None
    if not isinstance(system, str | Path):
        found = f"an object of type {type(system).__name__}"
        raise InputError("system", "", found, "what load_system gave, a name, or the path of a .toml file")
    from sms_adapters.system_file import load_system

    path = Path(system)
    return load_system(system), path.parent if path.suffix == ".toml" else None
