"""System descriptions by name, by path, or as tables."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sms_online.description.explain import hint, nearest
from sms_online.description.parse import parse_system, shipped_systems, shipped_text, system_of
from sms_online.description.schema import System
from sms_online.errors import InputError


def load_system(described: str | Path | Mapping[str, Any]) -> System:
    """Load a system: a shipped one by name, a `.toml` file by path, or the tables of one as a mapping.

    InputError, one line with file and key, where it is neither, or where what it says is wrong.
    """
    if isinstance(described, Mapping):
        return system_of(described, str(described.get("name", "system")))
    path_or_name = str(described)
    if path_or_name in shipped_systems():
        return parse_system(shipped_text(path_or_name), path_or_name)
    path = Path(path_or_name)
    if path.suffix != ".toml":
        names = shipped_systems()
        suggestion = hint(nearest(path_or_name, names))
        raise InputError(
            path_or_name, "", "no shipped system of this name", f"a .toml file or one of {', '.join(names)}{suggestion}"
        )
    try:
        text = path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(path_or_name, f"byte {error.start}", "not UTF-8 text", "a TOML file in UTF-8") from None
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(path_or_name, "", reason[0].lower() + reason[1:], "a readable system file") from None
    return parse_system(text, path_or_name)


def system_text(path_or_name: str) -> str:
    """The text of a system file, or of a shipped system by its name."""
    shipped = path_or_name in shipped_systems()
    return shipped_text(path_or_name) if shipped else Path(path_or_name).read_text(encoding="utf-8")
