"""The view's process: reads frames from stdin, draws them, reports one JSON line a message on stdout.

It is separate because rerun can block for ever, and so that its work takes no time from the estimator's interpreter.
It ends when its input ends, however that comes about.
"""

from __future__ import annotations

import json
import os
import pickle
import signal
import sys
from queue import Empty, Queue
from threading import Thread
from time import perf_counter
from typing import IO, TYPE_CHECKING

from sms_tools.view.frames import End, Event, Evidence, Frame, Start, TroubleError

if TYPE_CHECKING:
    from sms_tools.view.recorder import Recorder

# A recording is written in so long steps, s, for rerun keeps 2 kB in memory of every chunk written until it writes the
# file's footer. A person at a viewer waits no longer than the other.
SAVE_INTERVAL, SHOW_INTERVAL = 30.0, 0.1
# Pictures in a batch at most, of a replay that is faster than the clock: half a minute of a session.
LARGEST_BATCH = 600
# Frames read ahead; behind them the estimator's process notices that it must drop some.
READ_AHEAD = 8


def main() -> None:
    """Serve one session."""
    # Messages keep the real stdout; what libraries print must not get between them.
    messages = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    frames: Queue[Frame | None] = Queue(READ_AHEAD)
    Thread(target=_read, args=(sys.stdin.buffer, frames), daemon=True).start()
    start = frames.get()
    if isinstance(start, Start):
        _serve(start, frames, messages)
    # Rerun's own end waits for sinks that may never take their data; a server goes too, whoever has ended the session.
    if os.getpgrp() == os.getpid():  # as it is started by a session
        os.killpg(0, signal.SIGKILL)
    os._exit(0)


def _serve(start: Start, frames: Queue[Frame | None], messages: IO[str]) -> None:
    def say(**message: str) -> None:
        messages.write(json.dumps(message) + "\n")

    try:
        # Here, so that a broken installation of rerun is reported like any other trouble.
        from sms_online.threads import one_blas_thread
        from sms_tools.view.recorder import Recorder

        recorder = Recorder(start, lambda text: say(place=text))
        with one_blas_thread():
            _record(recorder, frames, SAVE_INTERVAL if start.choice.kind == "save" else SHOW_INTERVAL)
        say(done="")
    except TroubleError as error:
        say(trouble=str(error))
    except Exception as error:  # whatever else is wrong must not look like a session without a view
        say(trouble=f"{type(error).__name__}: {error}")
    while frames.get() is not None:  # keep reading, so that the hand-over stays cheap, and serving, where it serves
        pass


def _record(recorder: Recorder, frames: Queue[Frame | None], interval: float) -> None:
    """Draw until the session ends."""
    written = perf_counter()
    while True:
        try:
            frame = frames.get(timeout=interval)
        except Empty:
            recorder.write()
            written = perf_counter()
            continue
        if frame is None or isinstance(frame, End):
            recorder.end(frame)
            return
        if isinstance(frame, Event):
            recorder.event(frame)
        elif isinstance(frame, Evidence):
            recorder.evidence(frame)
        elif not isinstance(frame, Start):
            recorder.picture(frame)
        if recorder.waiting >= LARGEST_BATCH or perf_counter() - written >= interval:
            recorder.write()
            written = perf_counter()


def _read(pipe: IO[bytes], frames: Queue[Frame | None]) -> None:
    """Frames as they come; None at their end, which may be in the middle of one where the session was killed."""
    try:
        while True:
            frames.put(pickle.load(pipe))
    except (EOFError, pickle.UnpicklingError):
        pass
    finally:
        frames.put(None)


if __name__ == "__main__":
    main()
