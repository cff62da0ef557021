"""The live loop: what arrived in each tick of the session's clock is merged and estimated."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from sms_adapters.checkpoint import write_checkpoint
from sms_adapters.clock_merge import Merger
from sms_adapters.recorder import Recorder
from sms_adapters.recording import tick_time
from sms_online.checkpoint import Checkpoint
from sms_online.notices import unstated_latency
from sms_online.session import Session
from sms_online.stream import Block
from sms_online.verdict.sample_reasons import LARGEST_LOSS
from sms_tools.interruption import Interruption
from sms_tools.live.feed import READ_TIMEOUT, Feed, Interpreter, SessionClock, check_feeds
from sms_tools.live.latency import RECENT, Latencies
from sms_tools.live.status import Leading, News, StatusWriter

# A session that is killed loses no more of the estimate than this, s; its raw items are on disk all the same.
CHECKPOINT_INTERVAL = 5.0
CHECKPOINT = "checkpoint.msgpack"
# Devices are given so long to be opened before the session's first tick is processed, s.
OPENING = 2.0
# News is made so often, s.
NEWS_INTERVAL = 0.5
# What is done now and then waits so long for the end of a block, s.
LONGEST_BLOCK = 0.2
# Estimates are late from so many seconds on: the first ones wait for the clocks, a window and the filters.
LARGEST_LATENCY = 3.0
# Parameters on the status line: the best known ones.
LEADING = 4


class LiveSession:
    """Feeds, merger and estimator of one session, until it is interrupted.

    start: of the session's clock in the estimator's time, s. directory: where checkpoints go, which exists.
    interpreter: which the readers leave to the loop.
    """

    def __init__(
        self,
        clock: SessionClock,
        feeds: Sequence[Feed],
        merger: Merger,
        session: Session,
        start: float,
        directory: Path,
        recorder: Recorder | None = None,
        status: StatusWriter | None = None,
        interpreter: Interpreter | None = None,
    ) -> None:
        self.latencies = Latencies()
        self.notices: Callable[[], Sequence[str]] = tuple  # further lines of the status
        self.busy = 0.0  # s spent on samples
        self.health: Mapping[str, Mapping[str, float]] = {}  # latency and clock offsets, ms, by name; replaced when new
        self._clock = clock
        self._feeds = feeds
        self._merger = merger
        self._session = session
        self._estimator = session.estimator
        self._start = start
        self._directory = directory
        self._recorder = recorder
        self._status = status
        self._interpreter = Interpreter() if interpreter is None else interpreter
        self._tick = 0
        self._away = ("", -np.inf)  # which devices were gone or silent last, and when, s
        self._looked = 0.0
        self._said = 0.0
        self._said_samples = 0
        self._saved = 0.0
        self._saving = threading.Thread()
        self._unsaved = ""  # why a checkpoint could not be written

    def blocks(
        self,
        interruption: Interruption,
        duration: float = np.inf,
        ended: Callable[[], bool] = lambda: False,
        ready: Callable[[], None] = lambda: None,
    ) -> Iterator[Block]:
        """Yield the rows of each tick until interrupted, for `duration` s, or until `ended` says so; then what is left.

        ready: called when every device is open or found missing. Each block has to be pushed into the estimator before
        the next one is asked for. At the end the devices are released and a checkpoint is written, which knows nothing
        of the estimator's own end. Raises InputError where a device can never be opened.
        """
        for feed in self._feeds:
            feed.start()
        for feed in self._feeds:
            feed.tried.wait(OPENING)
            check_feeds(self._feeds, self._recorder)
        # What is there by now stays, and looking through it for garbage would stop the loop for a tenth of a second.
        gc.collect()
        gc.freeze()
        ready()
        try:
            while not (interruption.requested or ended() or self._clock() >= duration):
                interruption.sleep(tick_time(self._tick + 1) - self._clock())
                worked = self._clock() >= tick_time(self._tick + 1) and (yield from self._advance())
                self._look_around(worked)
        finally:
            gc.unfreeze()
            for feed in self._feeds:
                feed.stop()
        # What arrived until then, also where the loop was behind; what passes meanwhile is no silence.
        end = self._clock()
        while tick_time(self._tick) <= end:
            yield from self._advance()
        block = self._merger.finish()
        if block is not None:
            yield block
        self.save()

    def close(self) -> None:
        """Show the last news and end the recording."""
        self._publish()
        if self._recorder is not None:
            self._recorder.close(tick_time(self._tick), self.warnings)

    def _advance(self) -> Generator[Block, None, bool]:
        """One tick; whether there were rows in it."""
        self._tick += 1
        tick = tick_time(self._tick)
        behind = self._clock() - tick
        if behind > READ_TIMEOUT:  # in which a read comes back even where nothing is there
            for feed in self._feeds:
                feed.await_fetched(behind)
        items = [feed.drain(tick) for feed in self._feeds]
        started = time.perf_counter()
        with self._interpreter:
            block = self._merger.advance(tick, items)
            if block is not None:
                yield block
        newest = self._estimator.newest_row
        if block is not None and np.isfinite(newest):
            self.latencies.add(self._clock() + self._start, newest)
        self.busy += time.perf_counter() - started
        return block is not None

    def _look_around(self, worked: bool) -> None:
        """What is done now and then; worked: rows were processed just now, so that the next ones are furthest off."""
        now = self._clock() if worked else self._clock() - LONGEST_BLOCK
        if now - self._looked >= NEWS_INTERVAL:
            self._looked = now
            self.health = {"latency": self._latency(), "clocks": self._merger.clock_offsets}
            if self._status is not None:
                self._publish()
        if now - self._saved >= CHECKPOINT_INTERVAL and not self._saving.is_alive():
            self._saved = now
            # Writing takes as long as two blocks may, so it is not the loop's.
            state = self._session.checkpoint(self._merger)
            self._saving = threading.Thread(target=self._write, args=(state,), name="checkpoint")
            self._saving.start()

    def _write(self, state: Checkpoint) -> None:
        """Write a checkpoint; no disk is worth the session, which goes on and ends without."""
        try:
            write_checkpoint(self._directory / CHECKPOINT, state)
            self._unsaved = ""
        except OSError as error:
            self._unsaved = error.strerror or str(error)

    def _latency(self) -> dict[str, float]:
        """Quantiles of the latency, ms, as far as they are known."""
        quantiles = {"median": self.latencies.quantile(0.5), "p99": self.latencies.quantile(0.99)}
        return {name: 1e3 * value for name, value in quantiles.items() if value is not None}

    def save(self) -> None:
        """Write a checkpoint, now."""
        if self._saving.ident is not None:
            self._saving.join()
        self._write(self._session.checkpoint(self._merger))

    @property
    def warnings(self) -> list[str]:
        """What no raw item shows of this session."""
        found = [warning for feed in self._feeds for warning in feed.warnings]
        if self._unsaved:
            found.append(f"a checkpoint could not be written: {self._unsaved}")
        if self._recorder is not None and self._recorder.unrecorded:
            why = f" ({self._recorder.problem})" if self._recorder.problem else ""
            found.append(f"{self._recorder.unrecorded} items could not be recorded{why}")
        return found

    @property
    def troubles(self) -> list[str]:
        """What is wrong with the devices, the recording or the machine just now."""
        gone = {feed.name: f"{feed.name}: gone ({feed.lost}), tried again" for feed in self._feeds if feed.lost}
        silent = {name: f"{name}: silent" for name in self._merger.silent(tick_time(self._tick))}
        found = [*gone.values(), *silent.values()]
        if gone or silent:
            self._away = ", ".join(gone | silent), self._clock()
        if self._recorder is not None and self._recorder.problem is not None:
            found.append(f"not recorded: {self._recorder.problem}")
        late, behind = sum(self._merger.late), self.latencies.quantile(0.99)
        dropped = sum(feed.dropped for feed in self._feeds)
        if dropped:
            found.append(f"{dropped} items were recorded but not used: the machine is too slow")
        if late > LARGEST_LOSS * self._estimator.samples:
            found.append(f"{late} samples came too late to be used: the machine or a source is too slow")
        if behind is not None and behind > LARGEST_LATENCY:
            who, when = self._away
            # As long as the latencies remember.
            recent = self._clock() - when < 2.0 * RECENT
            why = f" after {who} had reconnected" if recent else ": the machine is too slow"
            found.append(f"estimates come {behind:.1f} s late{why}")
        return found

    def _publish(self) -> None:
        if self._status is None:
            return
        now = self._clock()
        troubles = self.troubles
        known = self._session.evaluation(troubles)
        pi, std = known.estimate.pi, known.std
        relative = std / np.maximum(np.abs(pi), np.finfo(float).tiny)
        best = [k for k in np.argsort(relative)[:LEADING].tolist() if np.isfinite(std[k])]
        parameters = known.parameters
        shares = [residual.relative for residual in known.residuals.values()]
        news = News(
            time=now,
            rate=(self._estimator.samples - self._said_samples) / max(now - self._said, 1e-9),
            latency=self.latencies.quantile(0.99),
            lost=self._estimator.counters.lost_samples,
            residual=max((share for share in shares if share is not None), default=None),
            determined=(int(np.count_nonzero(known.determined)), len(parameters)),
            leading=[Leading(parameters[k].name, parameters[k].unit, float(pi[k]), float(std[k])) for k in best],
            troubles=[
                *self.notices(),
                *troubles,
                *self._merger.warnings,
                *self.warnings,
                *unstated_latency(known.statistics),
            ],
            trust=known.trust,
        )
        self._said, self._said_samples = now, self._estimator.samples
        self._status.publish(news)
