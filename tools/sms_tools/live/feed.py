"""One device of a session: read in a thread of its own, recorded first, queued without ever waiting for anybody."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from math import inf

from sms_adapters.raw import CanFrames, LostDevice, Raw, Reader
from sms_adapters.recorder import Recorder
from sms_adapters.recording import split
from sms_adapters.session_log import from_microseconds, number_of_items, quantised
from sms_online.errors import InputError

# Longest wait in a read, s: how late a reader notices that the session ends.
READ_TIMEOUT = 0.1
# Waits before a lost device is tried again, s: each twice the one before, from the first to the longest.
FIRST_RETRY, LONGEST_RETRY = 0.1, 1.0
# Where the loop is behind, a reader has so long to fetch what came before a tick, s, and is polled so often. On a
# busy host it may be its turn only after some tenths.
FETCHING, LOOK = 0.5, 5e-4
# A reader leaves what has come with the driver while the loop computes, at most so long, s: a block takes less, and the
# usual buffers of a socket hold 300 frames.
COMPUTING = 0.02
# Items that may wait for the estimator: a dozen seconds of a busy bus, for the first fit of the momentum balance takes
# one or two. What comes when it is full is dropped: the samples that wait are then without a gap, which many small ones
# would be worth nothing.
MOST_WAITING = 65536


class Interpreter:
    """Gives the interpreter to the loop while it computes, which uses this as a context.

    At every system call of a reader another thread may take the interpreter for a millisecond, and both would be
    slower. What has come waits in the driver.
    """

    def __init__(self) -> None:
        self._free = threading.Event()
        self._free.set()

    def __enter__(self) -> None:
        self._free.clear()

    def __exit__(self, *error: object) -> None:
        self._free.set()

    def await_free(self) -> None:
        """Wait until the loop does not compute, for COMPUTING s at most."""
        self._free.wait(COMPUTING)


class SessionClock:
    """Seconds since the session began, by the machine's monotonic clock, in whole µs.

    epoch: UTC of its zero, µs.
    """

    def __init__(self) -> None:
        self._zero = time.monotonic_ns()
        self.epoch = time.time_ns() // 1000

    def __call__(self) -> float:
        """Now, s."""
        return from_microseconds((time.monotonic_ns() - self._zero) // 1000)


class Feed:
    """Reads a device until it is stopped; what was lost, retried and dropped is counted.

    queued: somebody drains it; else it is only recorded. lost: why the device is not there now, None while it is.
    losses: how often it went away.
    """

    def __init__(self, reader: Reader, recorder: Recorder | None, queued: bool = True) -> None:
        self.name = reader.name
        self.lost: str | None = "not opened yet"
        self.losses = 0
        self.last_loss = ""
        self.dropped = 0
        self.received = 0
        self._refused: InputError | None = None
        self.tried = threading.Event()  # to open the device, at least once
        self._fetched = inf  # machine's time when the last read came back, s; infinite while nothing can be read
        self._given_up = -inf  # what it was when the loop stopped waiting
        self._reader = reader
        self._recorder = recorder
        self._queued = queued
        self._queue: list[Raw] = []
        self._waiting = 0
        self._earliest = 0.0  # no arrival may be before this, s: the last one, or the tick that has been processed
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"read {self.name}", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def check(self) -> None:
        """Raise the InputError of a device that can never be opened."""
        if self._refused is not None:
            raise self._refused

    def stop(self) -> None:
        """Stop reading and release the device."""
        self._stopping.set()
        self._thread.join()

    def drain(self, tick: float) -> list[Raw]:
        """What arrived before the tick, s; whatever comes later counts as arrived at it, or after."""
        with self._lock:
            self._earliest = max(self._earliest, tick)
            early, self._queue = split(self._queue, tick)
            self._waiting -= number_of_items(early)
        return early

    def await_fetched(self, age: float) -> None:
        """Wait until all that came more than `age` s ago has been fetched, for FETCHING s at most.

        A loop that works off a backlog keeps the interpreter from the readers, and must not overtake them. A reader
        that was waited for in vain, and has fetched nothing since, is not waited for again.
        """
        began = time.monotonic()
        while self._given_up < self._fetched < began - age:
            if time.monotonic() > began + FETCHING:
                self._given_up = self._fetched
            time.sleep(LOOK)

    def _run(self) -> None:
        retry = FIRST_RETRY
        while not self._stopping.is_set():
            try:
                self._reader.open()
                self.lost = None
                self._fetched = time.monotonic()
                self.tried.set()
                while not self._stopping.is_set():
                    items = self._reader.read(READ_TIMEOUT)
                    if items:
                        retry = FIRST_RETRY
                        self._take(items)
                    self._fetched = time.monotonic()
            except LostDevice as error:
                self._lose(error.why)
            except InputError as error:
                self._refused = error
                self.tried.set()
                return
            # A driver may raise anything; a thread that ended silently would look like a device that says nothing.
            except Exception as error:
                self._lose(f"{type(error).__name__}: {error}")
            self._fetched = inf
            self._reader.close()
            self.tried.set()
            self._stopping.wait(retry)
            retry = min(2.0 * retry, LONGEST_RETRY)

    def _lose(self, why: str) -> None:
        if self.lost is None:
            self.losses += 1
        self.lost = self.last_loss = why

    def _take(self, items: Sequence[Raw]) -> None:
        """Record and queue, in one step, so that a tick drains all that is recorded as arrived before it."""
        with self._lock:
            taken: list[Raw] = []
            for item in items:
                if isinstance(item, CanFrames):
                    frames = quantised(item, self._earliest)
                    self._earliest = float(frames.arrival[-1])
                    taken.append(frames)
                else:
                    self._earliest = max(self._earliest, item.arrival)
                    taken.append(replace(item, arrival=self._earliest))
            count = number_of_items(taken)
            self.received += count
            full = self._queued and self._waiting + count > MOST_WAITING
            if self._recorder is not None:
                self._recorder.put(self.name, taken, dropped=full)
            if full:
                self.dropped += count
            elif self._queued:
                self._queue += taken
                self._waiting += count

    @property
    def warnings(self) -> list[str]:
        """What went wrong with the device, and what the estimator was too slow for, one sentence each."""
        found = []
        if self.losses:
            found.append(f"{self.name}: lost {self.losses} times and opened again; last reason: {self.last_loss}")
        elif self.lost is not None and not self.received:
            found.append(f"{self.name}: not available: {self.lost}")
        if self.dropped:
            found.append(f"{self.name}: {self.dropped} items recorded but not used, the estimator was too slow")
        return found


def check_feeds(feeds: Sequence[Feed], recorder: Recorder | None) -> None:
    """Raise the InputError of a device that can never be opened, with all released and the recording abandoned."""
    try:
        for feed in feeds:
            feed.check()
    except InputError:
        for feed in feeds:
            feed.stop()
        if recorder is not None:
            recorder.abandon()
        raise
