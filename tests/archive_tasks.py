"""Tasks that other processes import, some of which end their worker."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

from sms_online.errors import InputError


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
