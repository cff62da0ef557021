"""Where a session's view goes: the values of --rerun. Imports nothing heavy, for the command line reads it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import Literal

from sms_online.errors import InputError

Kind = Literal["off", "save", "serve", "spawn", "connect"]
EXPECTED = (
    "off, save, serve, serve=ADDRESS (of this machine; 0.0.0.0 for all), spawn "
    "or connect=URL (HOST:PORT, or rerun+http://HOST:PORT/proxy)"
)
DEFAULT_PORT = 9876
# Whoever can reach the server can also write into it, so nobody else's machine can unless that is asked for.
LOOPBACK = "127.0.0.1"
_ADDRESS = re.compile(r"(?:rerun\+http://)?(?P<host>[\w.-]+|\[[0-9A-Fa-f:]+\])(?::(?P<port>\d{1,5}))?(?:/proxy/?)?")


@dataclass(frozen=True)
class Choice:
    """A sink of the view; host and port of the viewer for `connect`, the server's own address for `serve`."""

    kind: Kind
    host: str = ""
    port: int = 0

    @property
    def url(self) -> str:
        """Address in rerun's own form."""
        return f"rerun+http://{self.host}:{self.port}/proxy"


def chosen(text: str) -> Choice:
    """The choice that a value of --rerun names; InputError where it names none."""
    try:
        return parse_choice(text)
    except ValueError as error:
        raise InputError("--rerun", "", str(error).split(";")[0], EXPECTED) from None


def parse_choice(text: str) -> Choice:
    """The choice that a value of --rerun names; ValueError saying what was expected."""
    if text == "off":
        return Choice("off")
    if text == "save":
        return Choice("save")
    if text == "spawn":
        return Choice("spawn")
    if text == "serve":
        return Choice("serve", LOOPBACK)
    if text.startswith("serve="):
        try:
            return Choice("serve", str(IPv4Address(text.removeprefix("serve="))))
        except ValueError:
            raise ValueError(f"{text!r}; expected {EXPECTED}") from None
    address = _ADDRESS.fullmatch(text.removeprefix("connect=")) if text.startswith("connect=") else None
    port = int(address["port"] or DEFAULT_PORT) if address else 0
    if address is None or not 0 < port < 65536:
        raise ValueError(f"{text!r}; expected {EXPECTED}")
    return Choice("connect", address["host"], port)
