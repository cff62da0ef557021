"""Ctrl-C as a request to finish with what has been read."""

from __future__ import annotations

import signal
import time
from types import FrameType, TracebackType
from typing import Any

# A person who presses Ctrl-C waits no longer than this, s.
PATIENCE = 0.1


class Interruption:
    """Inside its context the first Ctrl-C only sets `requested`; a second one raises KeyboardInterrupt as usual.

    An exception between two lines of the pipeline would leave it half way through a block.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: Any = None

    def __enter__(self) -> Interruption:
        self._before = signal.signal(signal.SIGINT, self._request)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def sleep(self, seconds: float) -> None:
        """Wait, but no longer once Ctrl-C is pressed."""
        end = time.monotonic() + seconds
        while not self.requested and (left := end - time.monotonic()) > 0:
            time.sleep(min(left, PATIENCE))
