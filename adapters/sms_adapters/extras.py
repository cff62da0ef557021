"""Packages of the optional extras, imported where they are needed."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from sms_online.errors import InputError


def installed(module: str, source: str, place: str = "", extra: str = "logs") -> Any:
    """A module of an extra; InputError says how to install it. source, place: what needs it."""
    try:
        return import_module(module)
    except ImportError:
        found = f"the package {module.partition('.')[0]} is not installed"
        raise InputError(source, place, found, f"it: pip install 'sms-online[{extra}]'") from None
