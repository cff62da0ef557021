"""The estimator's side of the view: cheap to feed, never waits for whoever looks."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from threading import Event as Flag
from threading import Thread
from time import perf_counter
from types import TracebackType
from typing import IO

import numpy as np

from sms_adapters.files import reading
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.snapshot import statistics_of
from sms_online.stream import Block
from sms_tools.interruption import Interruption
from sms_tools.view.choice import Choice, chosen
from sms_tools.view.frames import Circumstances, Diagnosed, End, Event, Evidence, Frame, Picture, Reference, Start
from sms_tools.view.handover import Handover

RECORDING = "session.rrd"
# Hand-overs a second of the session: samples as often as they are drawn; with every fifth the estimator's state, for it
# changes by internal blocks of a quarter second.
SAMPLES_RATE = 20.0
SAMPLES_A_STATE = 5
# Bytes in the pipe to the view's process, as many as Linux lets anybody have: fewer turns of who writes and who reads.
PIPE_SIZE = 1 << 20
# A view that has taken nothing for so long, s, is given up.
STALL = 10.0
# At the end of a session what is left gets so long to be written, s, each time some of it was taken.
CLOSING = 10.0
# The end is waited for in steps of, s.
STEP = 0.1
# A viewer in the same laboratory answers within this time, s.
PROBE_TIMEOUT = 1.0

# Further numbers of a live source, asked for with every state: `latency` and offsets of `clocks`, ms, name to value.
Health = Callable[[], Mapping[str, Mapping[str, float]]]


class View:
    """Shows one session, or with `off` nothing at all.

    status: one line for people, empty while all is well. warnings: what went wrong, for the results. circumstances: is
    asked for with every state.
    """

    def __init__(self, estimator: Estimator, start: Start | None, patient: bool, health: Health | None) -> None:
        self.status = ""
        self.warnings: list[str] = []
        self.circumstances: Callable[[], Circumstances] = Circumstances
        self._estimator = estimator
        self._patience = STALL if patient else 0.0
        self._health = health
        self._t = 0.0
        self._opened = False
        self._room = perf_counter()  # when the last frame was taken without one being dropped
        self._process: subprocess.Popen[bytes] | None = None
        self._handover: Handover | None = None
        self._done = Flag()
        self._serving = start is not None and start.choice.kind == "serve"
        if start is not None and start.choice.kind == "connect" and (missing := absent(start.choice)):
            self._trouble(missing)
        elif start is not None:
            # A session of its own: Ctrl-C is for the estimator, which then ends the view in order.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "sms_tools.view.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
                pipesize=PIPE_SIZE,
            )
            assert self._process.stdin is not None
            assert self._process.stdout is not None
            self._handover = Handover(self._process.stdin)
            Thread(target=self._listen, args=(self._process.stdout,), name="view messages", daemon=True).start()
            self._handover.put(start)

    def watch(self, blocks: Iterable[Block]) -> Iterator[Block]:
        """The same samples, in pieces no longer than the view's interval; each is shown once it has been used.

        The estimator's result does not depend on how samples are cut.
        """
        if self._handover is None:
            yield from blocks
            return
        longest = max(1, round(self._estimator.system.sample_rate * SAMPLES_A_STATE / SAMPLES_RATE))
        # Numbers of the display intervals that were shown last.
        shown = stated = -1
        waiting: list[Block] = []
        for block in blocks:
            for piece in block.pieces(longest):
                yield piece
                waiting.append(piece)
                self._t = float(piece.t[-1])
                interval = int(self._t * SAMPLES_RATE)
                if interval != shown:
                    state_due = interval // SAMPLES_A_STATE != stated
                    self._show(tuple(waiting), state_due)
                    waiting.clear()
                    shown, stated = interval, interval // SAMPLES_A_STATE

    def event(self, t: float, text: str) -> None:
        """Mark an instant, s, in the plots, and name it in the log."""
        self._put(Event(t, text))

    def evidence(self, t: float, scores: Mapping[str, float]) -> None:
        """Scores of candidate effects (`name@where`) at an instant, s."""
        self._put(Evidence(t, dict(scores)))

    def linger(self, interruption: Interruption) -> None:
        """Where the session is served: keep it so until Ctrl-C."""
        if self._serving and self._process is not None and not interruption.requested:
            print("the view stays until Ctrl-C", file=sys.stderr)
            while not interruption.requested and self._process.poll() is None:
                interruption.sleep(1.0)
        self._kill()

    def __enter__(self) -> View:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._handover is None:
            return
        if kind is None:
            self._put(End(self._t, statistics_of(self._estimator), self.circumstances()))
            self._close(self._handover)
        self._handover.close()
        if self._handover.dropped:
            self.warnings.append(f"{self._handover.dropped} pictures of the view dropped: it is too slow")
        if not (self._serving and kind is None and not self.status):
            self._kill()

    def _close(self, handover: Handover) -> None:
        """Wait until the view has finished, or takes nothing any more."""
        taken, since = handover.taken, perf_counter()
        while not self._done.wait(STEP):
            if handover.taken > taken:
                taken, since = handover.taken, perf_counter()
            elif perf_counter() - since > CLOSING:
                self._trouble(f"it did not finish within {CLOSING:g} s")

    def _show(self, blocks: tuple[Block, ...], with_state: bool) -> None:
        assert self._handover is not None
        health = self._health() if with_state and self._health is not None else {}
        state = statistics_of(self._estimator) if with_state else None
        circumstances = self.circumstances() if with_state else Circumstances()
        self._put(Picture(blocks, state, health, circumstances, perf_counter(), self._handover.dropped))

    def _put(self, frame: Frame) -> None:
        if self._handover is None or self.status:
            return
        if self._handover.put(frame, self._patience):
            self._room = perf_counter()
        elif perf_counter() - self._room > STALL:
            self._trouble(f"it took no data for {STALL:g} s")

    def _trouble(self, text: str) -> None:
        """Give the view up; the session goes on."""
        if not self.status:
            self.status = f"no view: {text}"
            self.warnings.append(f"the view ended at {self._t:.1f} s: {text}" if self._opened else self.status)
            print(self.status, file=sys.stderr)
        self._done.set()

    def _listen(self, messages: IO[bytes]) -> None:
        for line in messages:
            message: dict[str, str] = json.loads(line)
            if "place" in message:
                self._opened = True
                print(f"view: {message['place']}", file=sys.stderr)
            elif "trouble" in message:
                self._trouble(message["trouble"])
            else:
                self._done.set()
        if not self._done.is_set():
            self._trouble("its process ended")

    def _kill(self) -> None:
        if self._process is not None:
            with suppress(ProcessLookupError):
                # With a server that it has started, which outlives it where it was killed.
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()


def open_view(
    choice: str,
    estimator: Estimator,
    channels: tuple[str, ...],
    directory: Path,
    truth: Mapping[str, float] | None = None,
    *,
    patient: bool = False,
    exaggeration: float = 1.0,
    health: Health | None = None,
    diagnosed: Diagnosed | None = None,
) -> View:
    """A view of a session that has not begun, by the value of --rerun.

    channels: of the session's blocks. directory: where `save` writes session.rrd. truth: true physical parameters by
    name. patient: wait for the view rather than leave pictures out, for a source that can be kept waiting.
    exaggeration: factor on drawn deflections. health: see there; what it returns must not change afterwards. diagnosed:
    see there. Raises InputError on an unknown choice or a directory that cannot be made.
    """
    parsed = chosen(choice)
    if parsed.kind == "off":
        return View(estimator, None, patient, None)
    recording = directory / RECORDING
    if parsed.kind == "save":
        with reading(directory, "a directory that can be made"):
            directory.mkdir(parents=True, exist_ok=True)
    start = Start(
        statistics=statistics_of(estimator),
        channels=channels,
        choice=parsed,
        recording=recording,
        references=references(estimator, truth),
        exaggeration=exaggeration,
        live=health is not None,
        diagnosed=diagnosed,
    )
    return View(estimator, start, patient, health)


def absent(choice: Choice) -> str:
    """Why there is no viewer at the address, or nothing."""
    try:
        socket.create_connection((choice.host.strip("[]"), choice.port), PROBE_TIMEOUT).close()
    except OSError as error:
        return f"no viewer at {choice.url} ({error.strerror or error})"
    return ""


def references(estimator: Estimator, truth: Mapping[str, float] | None) -> tuple[Reference | None, ...]:
    """What each base parameter is compared with: the truth where it is known, else a nominal value other than zero."""
    base = estimator.base
    if truth is not None and all(p.name in truth for p in base.physical):
        values = base.values(np.array([truth[p.name] for p in base.physical]))
        return tuple(Reference(float(value), True) for value in values)
    return tuple(Reference(p.nominal, False) if p.nominal else None for p in base.parameters)
