"""Where a session's view goes: the values of --rerun. Imports nothing heavy, for the command line reads it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

Kind = Literal["off", "save", "serve", "spawn", "connect"]
EXPECTED = "off, save, serve, spawn or connect=URL (HOST:PORT, or rerun+http://HOST:PORT/proxy)"
DEFAULT_PORT = 9876
_ADDRESS = re.compile(r"(?:rerun\+http://)?(?P<host>[\w.-]+|\[[0-9A-Fa-f:]+\])(?::(?P<port>\d{1,5}))?(?:/proxy/?)?")


@dataclass(frozen=True)
class Choice:
    """A sink of the view; host and port of the viewer for `connect`."""

    kind: Kind
    host: str = ""
    port: int = 0

    @property
    def url(self) -> str:
        """Address in rerun's own form."""
        return f"rerun+http://{self.host}:{self.port}/proxy"


def parse_choice(text: str) -> Choice:
    """The choice that a value of --rerun names; ValueError saying what was expected."""
    if text == "off":
        return Choice("off")
    if text == "save":
        return Choice("save")
    if text == "serve":
        return Choice("serve")
    if text == "spawn":
        return Choice("spawn")
    address = _ADDRESS.fullmatch(text.removeprefix("connect=")) if text.startswith("connect=") else None
    port = int(address["port"] or DEFAULT_PORT) if address else 0
    if address is None or not 0 < port < 65536:
        raise ValueError(f"{text!r}; expected {EXPECTED}")
    return Choice("connect", address["host"], port)
