"""Tasks that other processes import, some of which end their worker."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_tools.archive.captures import identify
from sms_tools.archive.rows import Row

# The captures that were begun, a line each, beside the rows.
BEGUN = "begun.txt"
# The one whose worker is killed the first time.
DEADLY = "160.csv"


def square(log: Path, number: int, death: str) -> dict[str, Any]:
    """Square of a number; a line of `log` for each time that it is begun.

    death: `never`, `once` for the worker of the first time, or `always`; `error` and `input` raise.
    """
    with log.open("a", encoding="utf-8") as file:
        file.write(f"{number}\n")
    begun = log.read_text(encoding="utf-8").split().count(str(number))
    if death == "always" or (death == "once" and begun == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if death == "error":
        raise ZeroDivisionError("of its\nown")
    if death == "input":
        raise InputError("run.csv", "line 3", "no number", "a number")
    return {"square": number**2}


def linger(log: Path, seconds: float) -> dict[str, Any]:
    """Sleep so long; a line of `log` with the worker's process."""
    with log.open("a", encoding="utf-8") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(seconds)
    return {}


def identify_and_die(path: Path, system: System, directory: Path | None, out: Path) -> Row:
    """The row of a capture; the worker that begins DEADLY first is killed."""
    log = out.parent / BEGUN
    with log.open("a", encoding="utf-8") as file:
        file.write(f"{path.name}\n")
    if path.name == DEADLY and log.read_text(encoding="utf-8").split().count(DEADLY) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return identify(path, system, directory, out)
