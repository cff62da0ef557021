"""The reference of the Python API: every public name, by its docstring."""

from __future__ import annotations

import inspect

import sms_online


def api_page() -> str:
    """A table of all names of `sms_online.__all__`, functions first, then a block for mkdocstrings of each."""
    names = [name for name in getattr(sms_online, "__all__", ()) if name != "__version__"]
    names.sort(key=lambda name: isinstance(getattr(sms_online, name), type))
    rows = [f"| [`{name}`](#sms_online.{name}) | {_first_line(name)} |" for name in names]
    table = "\n".join(["| name | what it is |", "|---|---|", *rows, "| `__version__` | version of the package |"])
    return "\n\n".join([table, *(f"::: sms_online.{name}" for name in names)])


def _first_line(name: str) -> str:
    """The first sentence of a docstring, for a cell of a table."""
    return (inspect.getdoc(getattr(sms_online, name)) or "").split("\n\n")[0].replace("\n", " ").replace("|", "\\|")
