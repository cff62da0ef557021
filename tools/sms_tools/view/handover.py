"""A bounded queue from the estimator's thread to a pipe: putting costs microseconds, whatever the other end does."""

from __future__ import annotations

import pickle
from collections import deque
from threading import Event, Thread
from time import perf_counter, sleep
from typing import IO, Any

# Frames that wait for the other end: three seconds, live or of a replay five times as fast, which is more than the
# view's process needs to start. One that holds what the estimator knows shares most of it with the others; its own are
# 4 MB of a large arm.
CAPACITY = 64
# The sending thread looks so often for frames, s, about as often as there is one. Nobody wakes it: a wake-up costs who
# puts a system call, and often the core that it runs on.
TURN = 0.05
# A source that can be kept waiting looks so often whether there is room again, s.
LOOK_AGAIN = 0.001


class Handover:
    """Items put here are pickled and written to a pipe by a thread of its own, in order.

    Where the pipe does not take them, the oldest waiting items are dropped and counted.
    """

    def __init__(self, pipe: IO[bytes], capacity: int = CAPACITY) -> None:
        self.dropped = 0
        self.taken = 0  # items that are in the pipe
        self.broken = False
        self._pipe = pipe
        self._capacity = capacity
        self._waiting: deque[Any] = deque()
        self._closed = Event()
        self._thread = Thread(target=self._send, name="view hand-over", daemon=True)
        self._thread.start()

    def put(self, item: Any, patience: float = 0.0) -> bool:
        """Hand an item over; False where after `patience` seconds there was no room and the oldest was dropped.

        The item must not change afterwards: it is pickled later, by another thread.
        """
        if self.broken:
            return False
        if len(self._waiting) >= self._capacity:
            end = perf_counter() + patience
            while len(self._waiting) >= self._capacity and not self.broken and perf_counter() < end:
                sleep(LOOK_AGAIN)
        room = len(self._waiting) < self._capacity
        if not room:
            try:
                self._waiting.popleft()
                self.dropped += 1
            except IndexError:  # taken by the pipe just now
                pass
        self._waiting.append(item)
        return room

    def close(self) -> None:
        """Send nothing more."""
        self._closed.set()

    def _send(self) -> None:
        try:
            while not self._closed.is_set():
                try:
                    item = self._waiting.popleft()
                except IndexError:
                    self._closed.wait(TURN)
                    continue
                # Protocol 5 writes large arrays from where they are: a copy would hold the interpreter's lock.
                pickle.dump(item, self._pipe, protocol=5)
                self._pipe.flush()
                self.taken += 1
        except (OSError, ValueError):  # the other end is gone
            self.broken = True
