"""Sessions: samples in, many or one at a time, and a result at any time. `estimate` runs one over recorded data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from sms_online.capture import check_channels
from sms_online.checkpoint import HISTORY, Checkpoint
from sms_online.cramer_rao import MotionRecord, session_bound
from sms_online.data import Data, recorded_session
from sms_online.description.channels import channels as known_channels
from sms_online.description.given import Given, given_system
from sms_online.description.schema import System, TrackerChoice
from sms_online.diagnosis.searcher import Searcher
from sms_online.diagnosis.smoothed import running_diagnosis
from sms_online.errors import InputError
from sms_online.history import HistoryRecorder
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.snapshot import statistics_of
from sms_online.priors import GivenPrior, given_prior, known_beforehand
from sms_online.recorded import Recorded
from sms_online.result import Result, result_of
from sms_online.state import Stage
from sms_online.stream import Array, Block
from sms_online.trackers.build import check_trackers
from sms_online.trackers.parse import GRAMMAR, parse_tracker
from sms_online.truth import true_values
from sms_online.verdict.judged import JudgedEvaluation

# One or several trackers, as texts or records; None for those of the system file.
Trackers = str | TrackerChoice | Sequence[str | TrackerChoice] | None


def with_trackers(system: System, tracker: Trackers) -> System:
    """The system with these trackers in place of its own, if any; InputError for what is none."""
    if tracker is None:
        return system
    asked = [tracker] if isinstance(tracker, str | TrackerChoice) else list(tracker)
    for each in asked:
        if not isinstance(each, str | TrackerChoice):
            raise InputError("tracker", "", repr(each), GRAMMAR)
    chosen = tuple(parse_tracker(each) if isinstance(each, str) else each for each in asked)
    check_trackers(chosen, "--tracker")
    return system.model_copy(update={"trackers": chosen}) if chosen else system


class Session:
    """Estimates a system's parameters while samples come, and names effects that the system file lacks.

    system: a `System`, or the name or file of one. channels: names, in the order of the values. prior: True for the
    nominal values, each ± 10 %, or earlier results of the arm, as a `Result`, a results.json or the folder of a run,
    whose estimates hold with their covariance; priors that the system file states always hold. adopt: add missing
    effects to the model as soon as they are named. tracker: replaces that of the system file,
    "rls:forgetting=exponential,memory=5" or "kalman:drift=learned" for instance; of several the first gives the
    estimate. source: name of the source of the samples, for messages. searcher: makes the searches of the diagnosis, by
    default at once in this process. checkpoint: state to continue from. The result depends on the samples alone, to the
    last bit, however they are cut into updates. Raises InputError for a channel that the system does not have, or one
    that is missing, and where `prior` leads to no results.
    """

    def __init__(
        self,
        system: Given,
        channels: Sequence[str],
        *,
        prior: GivenPrior = False,
        adopt: bool = False,
        tracker: Trackers = None,
        source: str = "session",
        searcher: Searcher | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        system = with_trackers(given_system(system)[0], tracker)
        self.channels = tuple(channels)
        check_channels(self.channels, known_channels(system), source)
        self.estimator = Estimator(system, self.channels, source)
        known = given_prior(prior)
        # A prior is on the base parameters, which the estimator has found.
        beforehand = known_beforehand(system, self.estimator.base, known)
        if beforehand is not None:
            self.estimator.set_prior(beforehand)
        # Before the diagnosis, which may have the estimator go on with others.
        self.recorder = HistoryRecorder(self.estimator)
        self.estimator.observers.append(self.recorder)
        if checkpoint is not None:
            checkpoint.put_into(self.estimator)
            checkpoint.put_beside(HISTORY, self.recorder)
        if searcher is None:
            # A live session has its searches made by another process, and does not import them.
            from sms_online.diagnosis.online_search import Immediate

            searcher = Immediate()
        self.diagnosis = running_diagnosis(self.estimator, searcher, adopt, source, known)
        self.busy = 0.0  # s of computing
        self._begun = {"channels": self.channels, "prior": known, "adopt": adopt, "source": source}
        self._source = source
        self._last = -np.inf  # time of the newest sample, s
        self._result: Result | None = None

    @property
    def system(self) -> System:
        """The system as described."""
        return self.estimator.system

    @overload
    def update(self, samples: Block, /) -> None: ...

    @overload
    def update(self, t: ArrayLike, values: ArrayLike, /) -> None: ...

    def update(self, samples: Block | ArrayLike, values: ArrayLike | None = None, /) -> None:
        """Process samples: a block, or t (B,), s, and values (B, C), or one instant and its values (C,).

        Values are in SI units, in the order of the session's channels, NaN where there is none. InputError where shapes
        or channels do not fit, times go back, a value is infinite, or the session is finished.
        """
        block = samples if isinstance(samples, Block) else self._block(samples, values)
        self._check(block)
        start = perf_counter()
        self.estimator.push(block)
        self.busy += perf_counter() - start
        self._result = None

    def _block(self, t: ArrayLike, values: ArrayLike | None) -> Block:
        times = np.atleast_1d(np.asarray(t, dtype=np.float64))
        numbers = np.asarray([] if values is None else values, dtype=np.float64)
        if numbers.ndim == 1 and times.size == 1:
            numbers = numbers[None]
        if times.ndim != 1 or numbers.shape != (times.size, len(self.channels)):
            expected = f"({times.size}, {len(self.channels)}): a row a time, a column a channel"
            raise InputError(self._source, "update", f"values of shape {numbers.shape}", expected)
        return Block(times, self.channels, numbers)

    def _check(self, block: Block) -> None:
        if self.estimator.finished:
            raise InputError(self._source, "update", "samples after finish()", "a new session")
        if block.channels != self.channels:
            raise InputError(
                self._source, "update", f"channels {', '.join(block.channels)}", f"{', '.join(self.channels)}"
            )
        step = np.diff(block.t, prepend=self._last)
        if not (step >= 0.0).all():
            at = float(block.t[int(np.argmin(step >= 0.0))])
            raise InputError(self._source, "update", f"time {at:g} s", "times that do not go back")
        if np.isinf(block.values).any():
            column = int(np.isinf(block.values).any(axis=0).argmax())
            found, expected = f"an infinite value of {self.channels[column]}", "finite numbers, or NaN for none"
            raise InputError(self._source, "update", found, expected)
        if block.t.size:
            self._last = float(block.t[-1])

    def pause(self) -> None:
        """Expect a pause: no sample until the next one, after a second or more, counts as lost."""
        self.estimator.renew()
        self._result = None

    def finish(self) -> None:
        """End the session: process the samples that wait for later ones. The result is then final."""
        if self.estimator.finished:
            return
        start = perf_counter()
        self.estimator.finish()
        self.diagnosis.finish()
        self.recorder.finish()
        self.busy += perf_counter() - start
        self._result = None

    @property
    def result(self) -> Result:
        """The result of the samples so far. Before `finish` it does not state physical consistency."""
        if self._result is None:
            self._result = self.evaluate()
        return self._result

    def evaluation(self, troubles: Sequence[str] = ()) -> JudgedEvaluation:
        """The evaluation of the samples so far, computed on request. troubles: further reasons to doubt."""
        statistics = statistics_of(self.estimator)
        return JudgedEvaluation(statistics, self.estimator.estimate(), self.diagnosis.discrepancies, troubles)

    def evaluate(
        self,
        truth: Mapping[str, Any] | None = None,
        bound: Array | None = None,
        warnings: Sequence[str] = (),
        throughput: float | None = None,
    ) -> Result:
        """The result of the samples so far, with what is known from outside the session.

        truth: of a simulated capture, see `Capture`. bound (n,): Cramér–Rao bound of each parameter's std. warnings: of
        the source. throughput: samples/s, by default of computing alone.
        """
        true = None if truth is None else true_values(truth, self.system, self.diagnosis.system)
        if throughput is None:
            throughput = self.estimator.samples / self.busy if self.busy else 0.0
        return result_of(self.evaluation(), true, bound, warnings, self.diagnosis.document(), throughput, self.recorder)

    def checkpoint(self, source: Stage | None = None) -> Checkpoint:
        """The present state, to continue from; takes milliseconds. source: of the samples, if it keeps a state too."""
        return Checkpoint.of(self.estimator, self._begun, source, self.recorder)

    def save(self) -> bytes:
        """The present state as bytes for `restore`, with the system, its channels and the options."""
        return self.checkpoint().to_bytes()

    @staticmethod
    def restore(saved: bytes) -> Session:
        """Continue from the bytes of `save`: the estimate is the same to the last bit.

        Limitations: the running diagnosis begins anew; samples before are no longer searched, and what it has found by
        then is in the estimate if it was adopted, but no longer among the findings. InputError where `saved` is none.
        """
        checkpoint = Checkpoint.from_bytes(saved, "saved session")
        begun = dict(checkpoint.head.begun)
        if not begun:
            raise InputError("saved session", "", "a checkpoint of another kind", "what Session.save gave")
        system = System.model_validate(checkpoint.head.system)
        return Session(system, begun.pop("channels"), checkpoint=checkpoint, **begun)


def estimate(
    system: Given,
    data: Data,
    *,
    prior: GivenPrior = False,
    adopt: bool = False,
    bound: bool = False,
    tracker: Trackers = None,
) -> Result:
    """Estimate the parameters of a system from recorded data, to the same bits as a replay or the live session.

    system: a `System`, or the name or file of one. data: a capture, the path of one, of a log or of a recording, or
    blocks of samples in order of time. prior, adopt, tracker: as for `Session`. bound: compute the Cramér–Rao bound of
    every parameter too. Raises InputError if the data cannot be read or do not fit the system.
    """
    system, folder = given_system(system)
    recorded = recorded_session(system, data, folder)
    session, record = session_of(system, recorded, prior, adopt, bound, tracker)
    for block in recorded.source:
        session.update(block)
    session.finish()
    least = None if record is None else session_bound(session.estimator, record)
    return session.evaluate(recorded.truth, least, recorded.source.warnings)


def session_of(
    system: System, recorded: Recorded, prior: GivenPrior, adopt: bool, bound: bool, tracker: Trackers
) -> tuple[Session, MotionRecord | None]:
    """The session of a recording as it was begun, before its first sample; with what a bound follows from, if wanted.

    prior, adopt, tracker: as for `Session`; the recorded trackers unless given.
    """
    session = Session(
        system,
        recorded.source.channels,
        prior=prior,
        adopt=adopt,
        tracker=recorded.trackers if tracker is None else tracker,
        source=recorded.name,
        searcher=recorded.searcher(adopt),
        checkpoint=recorded.checkpoint,
    )
    record = MotionRecord(system.sample_rate) if bound else None
    if record is not None:
        session.estimator.observers.append(record)
    return session, record
