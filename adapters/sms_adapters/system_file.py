"""System descriptions by name, by path, or as tables."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sms_online.description.explain import hint, nearest
from sms_online.description.parse import parse_system, shipped_systems, shipped_text, system_of
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.trackers.build import check_trackers


def load_system(described: str | Path | Mapping[str, Any]) -> System:
    """Load a system: a shipped one by name, a `.toml` file by path, or the tables of one as a mapping.

    InputError, one line with file and key, where it is neither, or where what it says is wrong.
    """
    if isinstance(described, Mapping):
        source = str(described.get("name", "system"))
        system = system_of(described, source)
    else:
        source = str(described)
        system = parse_system(_text(source), source)
    check_trackers(system.trackers, source)
    return system


def _text(path_or_name: str) -> str:
    if path_or_name in shipped_systems():
        return shipped_text(path_or_name)
    path = Path(path_or_name)
    if path.suffix != ".toml":
        names = shipped_systems()
        suggestion = hint(nearest(path_or_name, names))
        found = "no such file or folder" if path.parent != Path() else "no shipped system of this name"
        found = "no system file" if path.exists() else found
        raise InputError(path_or_name, "", found, f"a .toml file or one of {', '.join(names)}{suggestion}")
    try:
        return path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(path_or_name, f"byte {error.start}", "not UTF-8 text", "a TOML file in UTF-8") from None
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(path_or_name, "", reason[0].lower() + reason[1:], "a readable system file") from None


def system_text(path_or_name: str) -> str:
    """The text of a system file, or of a shipped system by its name."""
    shipped = path_or_name in shipped_systems()
    return shipped_text(path_or_name) if shipped else Path(path_or_name).read_text(encoding="utf-8")
