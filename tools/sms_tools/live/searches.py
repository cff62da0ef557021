"""Searches of a live session beside its loop, made by a process of their own."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import IO

from sms_adapters.searches import BEGUN, LOST, NAME, USED
from sms_online.diagnosis.searcher import AnyRequest, Outcome


class SearchProcess:
    """Searches in a process of low priority, one at a time; those that come meanwhile are left out.

    Which were begun, and at which internal block each was used or lost, is written to `directory`, for the replay.
    problem: why there are no more of them, None while there are.
    """

    def __init__(self, directory: Path, adopt: bool) -> None:
        self.problem: str | None = None
        self._closing = False
        # A session of its own: Ctrl-C is for the estimator, which then ends the process.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "sms_tools.live.search_worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        self._log = (directory / NAME).open("w", encoding="utf-8", buffering=1)
        self._log.write(json.dumps({"adopt": adopt}) + "\n")
        self._requests: SimpleQueue[tuple[int, AnyRequest] | None] = SimpleQueue()
        self._done: SimpleQueue[tuple[str, int, Outcome | None]] = SimpleQueue()
        self._busy = False
        Thread(target=self._run, name="searches", daemon=True).start()

    def submit(self, number: int, request: AnyRequest) -> bool:
        """See `Searcher`."""
        if self._busy or self.problem is not None:
            return False
        self._busy = True
        self._note({BEGUN: number})
        self._requests.put((number, request))
        return True

    def outcome(self, block: int) -> tuple[int, Outcome | None] | None:
        """See `Searcher`."""
        if self._done.empty():
            return None
        kind, number, outcome = self._done.get()
        self._busy = False
        self._note({kind: number, "block": block})
        return number, outcome

    def _note(self, entry: dict[str, int]) -> None:
        try:
            self._log.write(json.dumps(entry) + "\n")
        except OSError as error:
            # No disk is worth the session.
            self.problem = f"a search could not be recorded, so a replay will differ: {error.strerror or error}"

    def close(self) -> None:
        """End the process, and a search that runs."""
        self._closing = True
        self._requests.put(None)
        self._process.kill()
        self._process.wait()
        self._log.close()

    def _run(self) -> None:
        """Hand requests over and take answers, neither of which may wait in the loop's thread."""
        to, back = self._process.stdin, self._process.stdout
        assert to is not None
        assert back is not None
        while (task := self._requests.get()) is not None:
            try:
                self._done.put((USED, task[0], _asked(task[1], to, back)))
            except (OSError, EOFError, pickle.UnpicklingError) as error:
                if not self._closing:
                    self.problem = f"no more searches for effects: their process ended ({type(error).__name__})"
                self._done.put((LOST, task[0], None))
                return


def _asked(request: AnyRequest, to: IO[bytes], back: IO[bytes]) -> Outcome | None:
    pickle.dump(request, to)
    to.flush()
    outcome: Outcome | None = pickle.load(back)
    return outcome
