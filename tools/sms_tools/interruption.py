"""Ctrl-C, a stopped service and a closed terminal as a request to finish with what has been read."""

from __future__ import annotations

import os
import signal
import time
from types import FrameType, TracebackType
from typing import Any

# A person who presses Ctrl-C waits no longer than this, s.
PATIENCE = 0.1
OUTPUTS = (1, 2)


class Interruption:
    """Inside its context the first Ctrl-C only sets `requested`; a second one raises KeyboardInterrupt as usual.

    SIGTERM does what Ctrl-C does, and so does the first SIGHUP, unless it is ignored (nohup). An exception between two
    lines of the pipeline would leave it half way through a block.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[int, Any] = {}
        self._terminals: list[int] = []

    def __enter__(self) -> Interruption:
        self._terminals = [descriptor for descriptor in OUTPUTS if os.isatty(descriptor)]
        handlers = {signal.SIGINT: self._request, signal.SIGTERM: self._terminate, signal.SIGHUP: self._hang_up}
        if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
            del handlers[signal.SIGHUP]
        self._before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def _terminate(self, number: int, frame: FrameType | None) -> None:
        signal.raise_signal(signal.SIGINT)

    def _hang_up(self, number: int, frame: FrameType | None) -> None:
        # The kernel and the shell each send one, and a second Ctrl-C would end the session without its results.
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        for descriptor in self._terminals:
            if not os.isatty(descriptor):  # it is gone, and every write to it would fail
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, descriptor)
                os.close(nowhere)
        signal.raise_signal(signal.SIGINT)

    def sleep(self, seconds: float) -> None:
        """Wait, but no longer once Ctrl-C is pressed."""
        end = time.monotonic() + seconds
        while not self.requested and (left := end - time.monotonic()) > 0:
            time.sleep(min(left, PATIENCE))
