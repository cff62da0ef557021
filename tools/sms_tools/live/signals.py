"""SIGTERM and SIGHUP as Ctrl-C: a stopped service and a closed terminal's session save what they have."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

OUTPUTS = (1, 2)


@contextmanager
def termination_interrupts() -> Iterator[None]:
    """Inside, SIGTERM does what Ctrl-C does, and so does the first SIGHUP, unless it is ignored (nohup)."""
    terminals = [descriptor for descriptor in OUTPUTS if os.isatty(descriptor)]

    def interrupt(number: int, frame: FrameType | None) -> None:
        signal.raise_signal(signal.SIGINT)

    def hang_up(number: int, frame: FrameType | None) -> None:
        # The kernel and the shell each send one, and a second Ctrl-C would end the session without its results.
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        for descriptor in terminals:
            if not os.isatty(descriptor):  # it is gone, and every write to it would fail
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, descriptor)
                os.close(nowhere)
        signal.raise_signal(signal.SIGINT)

    terminated = signal.signal(signal.SIGTERM, interrupt)
    hung_up = signal.getsignal(signal.SIGHUP)
    if hung_up is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, hang_up)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, terminated)
        signal.signal(signal.SIGHUP, hung_up)
