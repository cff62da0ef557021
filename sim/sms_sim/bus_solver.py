"""The motion of a simulated arm, solved in a process of its own beside the one that sends what is due."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection

from sms_online.errors import InputError
from sms_online.stream import Block
from sms_online.threads import one_blas_thread
from sms_sim.bus_motion import MovingArm

# Once the arm has set out: what is due, and who reads it, go first.
NICENESS = 10


class Solver:
    """An arm's blocks, from a process of its own, which begins to solve when the first is asked for.

    share: of a core that solving has had so far. The process is forked at once, before there are ports and buses that
    it would hold open after the end of this one.
    """

    def __init__(self, arm: MovingArm) -> None:
        self.share = 1.0
        self._pipe, theirs = multiprocessing.Pipe()
        context = multiprocessing.get_context("fork")
        self._process = context.Process(target=_solve, args=(arm, theirs, self._pipe), daemon=True)
        self._process.start()
        theirs.close()

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks; raises the arm's InputError."""
        try:
            self._pipe.send(None)
            began = time.monotonic()
            while isinstance(item := self._pipe.recv(), tuple):
                block, seconds = item
                self.share = seconds / (time.monotonic() - began)
                yield block
            raise item
        except EOFError:
            return
        finally:
            self._process.terminate()

    def give_way(self) -> None:
        """Solve on at a lower priority."""
        assert self._process.pid is not None
        with contextlib.suppress(ProcessLookupError):  # it has solved all
            os.setpriority(os.PRIO_PROCESS, self._process.pid, NICENESS)


def _solve(arm: MovingArm, pipe: Connection, others: Connection) -> None:
    others.close()  # or the death of the process that reads would go unnoticed
    try:
        pipe.recv()
        began = time.process_time()
        with one_blas_thread():
            for block in arm:
                pipe.send((block, time.process_time() - began))
    except InputError as error:
        pipe.send(error)
    except (EOFError, ConnectionError, KeyboardInterrupt):
        return
    finally:
        pipe.close()
