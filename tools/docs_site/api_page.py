"""The reference of the Python API: every public name, by its docstring."""

from __future__ import annotations

import sms_online


def api_page() -> str:
    """A block for mkdocstrings of each name of `sms_online.__all__`."""
    names = [name for name in getattr(sms_online, "__all__", ()) if name != "__version__"]
    return "\n\n".join(f"::: sms_online.{name}" for name in names)
