"""The trackers that a person has chosen, on the same rows: the first is judged, the others are read beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sms_online.calibration.nuisance import Nuisance
from sms_online.description.schema import LEARNED, LEAST_SQUARES, TrackerChoice
from sms_online.model.parameters import Parameter
from sms_online.pipeline.drift_line import DriftLine
from sms_online.pipeline.errors_in_variables import NoiseBias
from sms_online.pipeline.latency import clock_groups
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.white_rows import WhiteRows
from sms_online.state import Stage, State
from sms_online.stream import Array
from sms_online.trackers.build import Tracked, build_tracker, build_watch
from sms_online.trackers.drift import LearnedTrend
from sms_online.trackers.drift_filter import STEP
from sms_online.trackers.drift_search import Ramp
from sms_online.trackers.drift_state import Found
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Estimate, Prior, Rows, Tracker, joined

# From one look at what the judged tracker says of drifts to the next, s; sooner where by then their rates would lead
# further off than this share of the error of what drifts.
LOOKED, LED_OFF = 1.0, 0.3
# Times behind an alarm, s, before which a drift may yet show where the judged tracker learns them, and where it is
# unclear till then whether it was one.
WAITED, LONGEST_WAITED = 4.4, 6.5
# From one look whether rows determine all to the next: rows for each parameter.
ROWS_A_PARAMETER = 20


def session_trackers(sensing: Sensing, momentum: bool) -> tuple[TrackerChoice, ...]:
    """The trackers of a session: those that are stated, or one that learns drifts where these can be known.

    Without a momentum balance it has no rows, and clocks of several devices wander as if parameters moved.
    """
    learned = momentum and not clock_groups(sensing)
    return sensing.model.system.trackers or ((LEARNED,) if learned else (LEAST_SQUARES,))


@dataclass(frozen=True)
class Reading:
    """The reading of one tracker at an instant.

    label: its name for people. memory: s of rows that the estimate rests on. drifts: learned so far, by column of the
    estimate.
    """

    label: str
    estimate: Estimate
    memory: float
    drifts: tuple[Found, ...] = ()


@dataclass(frozen=True)
class _Chosen:
    """A tracker with its choice; None where it is the session's own least squares."""

    choice: TrackerChoice
    tracker: Tracker | None


def rows_per_second(rows_a_window: int, span: float) -> float:
    """Rows of windows of `span` s that come in a second."""
    return rows_a_window * HOPS / span


@dataclass(frozen=True)
class Change:
    """An alarm of the detector: between which instants parameters began to be others, and the newest sample's, s."""

    onset: float
    alarm: float
    newest: float


@dataclass(frozen=True)
class Suspected:
    """An unfollowed change: parameters that may move, since when, s; learning: whether drifts are learned."""

    parameters: tuple[str, ...]
    since: float
    learning: bool


class BankState(State):
    """What a bank of trackers keeps beside them.

    reference (n,): parameters from which a drift counts, None where nothing has moved. since: s, when what an alarm
    is of may have begun, inf without one. none: it is of no drift.
    """

    reference: Array | None = None
    since: float = np.inf
    none: bool = False


class TrackerBank(Stage):
    """The chosen trackers of one session, from one event to the next.

    trackers: those of the session. name: of the system. parameters (n,): columns of the rows behind those of the
    nuisances. prior: of the parameters; within: what the trackers go on from holds it. span: of a window, s. steady:
    all channels have one clock; clocks of several devices wander, as if parameters moved, and no drift is suspected.
    InputError where a choice does not fit the parameters.
    """

    def __init__(
        self,
        trackers: Sequence[TrackerChoice],
        name: str,
        parameters: Sequence[Parameter],
        nuisances: Sequence[Nuisance],
        prior: Prior | None,
        within: bool,
        rows_a_window: int,
        span: float,
        steady: bool,
    ) -> None:
        self._steady = steady
        self._nuisances, self._rows_a_window = len(nuisances), rows_a_window
        tolerance = np.array([each.tolerance for each in nuisances])
        nothing = np.full(len(parameters), np.nan)
        tolerances = Prior(np.zeros(tolerance.size), np.where(np.isfinite(tolerance), tolerance, np.nan))
        known = joined(tolerances, Prior(nothing, nothing) if prior is None or within else prior)
        self._weighted = prior is not None
        self._rows_per_second = rows_per_second(rows_a_window, span)
        rate = self._rows_per_second
        look = ROWS_A_PARAMETER * (tolerance.size + len(parameters))
        tracked = Tracked(parameters, tolerance.size, known, prior is not None, rate, name, look)
        self._chosen = [
            _Chosen(choice, None if choice.static and trackers[0].static else build_tracker(choice, tracked))
            for choice in trackers
        ]
        self._names = [p.name for p in parameters]
        # A judged tracker that lets nothing move is watched: rows that show a drift speak against it.
        self._still = trackers[0].still
        self._watch = build_watch(tracked) if steady and self._still else None
        # By name, for each is saved as a stage within.
        for k, chosen in enumerate(self._chosen):
            if chosen.tracker is not None:
                setattr(self, f"tracker_{k}", chosen.tracker)
        self.state = BankState()

    @property
    def others(self) -> list[Tracker]:
        """The trackers beside the session's own least squares."""
        return [chosen.tracker for chosen in self._chosen if chosen.tracker is not None]

    @property
    def _fed(self) -> list[Tracker]:
        return self.others if self._watch is None else [*self.others, self._watch]

    @property
    def unwatched(self) -> bool:
        """Whether the judged tracker lets nothing move, and no drift is watched for either."""
        return self._watch is None and self._still

    @property
    def suspected(self) -> Suspected | None:
        """A change of parameters that the rows show and the judged tracker does not follow."""
        learner = (self._watch or self.learned) if self._steady else None
        change = None if learner is None else learner.state.suspected
        if change is None:
            return None
        names = tuple(self._names[column - self._nuisances] for column in change.columns)
        return Suspected(names, change.since * STEP, self.learned is not None)

    def begin(self, known: Information) -> None:
        """Forget all rows, and go on from what is known of nuisances and parameters after an event."""
        self.release()
        for tracker in self._fed:
            # What is known beforehand of the nuisances is each tracker's own already.
            tracker.begin(known.without(range(self._nuisances)))

    @property
    def learned(self) -> LearnedTrend | None:
        """The judged tracker, if it learns drifts."""
        judged = self._chosen[0].tracker
        return judged if isinstance(judged, LearnedTrend) else None

    @property
    def accepted(self) -> int:
        """How often the judged tracker has found a drift to begin or to change, since the last event."""
        return 0 if self.learned is None else self.learned.state.accepted

    @property
    def patient(self) -> bool:
        """Whether more than noise may be a drift that is yet to be learned."""
        return self.learned is not None and self.learned.patient

    @property
    def drifting(self) -> tuple[str, ...]:
        """Parameters that the judged tracker has found to drift."""
        columns = [] if self.learned is None else self.learned.columns
        return tuple(self._names[column - self._nuisances] for column in columns)

    def rows(self, white: WhiteRows, t: float) -> Rows:
        """Rows of a window centred at t, s, with the drift that was subtracted from them.

        Columns of what may begin behind an alarm, which follow those of the parameters, are left out.
        """
        m, n, b, ramp = self._nuisances, len(self._names), white.Y[:, -1], None
        Y = white.Y[:, : m + n]
        if self.follows:
            ramp = np.concatenate((np.zeros((len(Y), m)), white.ramp[:, :n]), axis=1)
        if white.drift is not None:
            b = b + Y[:, m:] @ white.drift.moved[:n] + white.ramp[:, :n] @ white.drift.rate[:n]
        return Rows(Y, b, np.ones(b.size), np.full(b.size, t), ramp)

    def update(self, rows: Rows, quiet: bool, moves: bool) -> None:
        """Take in rows of nuisances and parameters; quiet: they leave no more than noise; moves: the arm does."""
        for tracker in self._fed:
            if isinstance(tracker, LearnedTrend):
                tracker.state.quiet = quiet
                tracker.state.moves |= moves
            tracker.update(rows)

    def hold(self, since: float) -> None:
        """Wait until it is known what an alarm is of, which may have begun at `since`, s."""
        if self.learned is not None:
            self.state.since = since

    def decide_on_drift(self, change: Change, behind: Sequence[Rows], unclear: bool, last: bool) -> Ramp | None:
        """The drift that a change is; None where it is none, so that an event is decided on, or none so far.

        behind: rows since the alarm. unclear: a step that they show may go on. last: no more rows come.
        """
        assert self.learned is not None
        found = self.learned.break_between(change.onset, change.alarm, behind)
        waited = change.newest - change.alarm
        if found.drift is None and (last or waited >= WAITED):
            earlier = self.learned.ramp_before(change.onset, change.alarm, behind)
            found = replace(earlier, unclear=earlier.unclear or found.unclear)
        self.state.none = last or waited >= (LONGEST_WAITED if unclear or found.unclear else WAITED)
        return found.drift

    def go_on_behind(self, change: Change, drift: Ramp, behind: Sequence[Rows] = ()) -> None:
        """Go on behind a change that is a drift, and with rows behind it."""
        assert self.learned is not None
        self.learned.go_on_behind(change.onset, change.alarm, drift, behind)

    def release(self) -> None:
        """It is known what the alarm was of."""
        self.state.since, self.state.none = np.inf, False

    def hold_until(self, t: float) -> None:
        """Have estimates of parameters that drift hold at t, s."""
        for tracker in self.others:
            if isinstance(tracker, LearnedTrend):
                tracker.state.until = t

    @property
    def follows(self) -> bool:
        """Whether parameters may move in the judged estimate."""
        return self._chosen[0].tracker is not None

    def drift(self, own: Callable[[], Estimate], t: float, before: DriftLine | None) -> DriftLine | None:
        """By how much parameters have moved, as the judged tracker has it at t, s; None where nothing has.

        own: the estimate by the session's least squares. before: the last such line.
        """
        judged = self._chosen[0].tracker
        if judged is None or (before is not None and t < before.due):
            return before
        if isinstance(judged, LearnedTrend) and not judged.moves.any():
            return None
        return self._line(judged, own, t) or before

    def _line(self, judged: Tracker, own: Callable[[], Estimate], t: float) -> DriftLine | None:
        m = self._nuisances
        estimate = judged.estimate()
        if not estimate.determined[m:].all():
            return None
        moves, rate = np.ones(estimate.pi.size, dtype=np.bool_), np.zeros(estimate.pi.size)
        decay, holds, instant = rate, LOOKED, t
        if isinstance(judged, LearnedTrend):
            moves, (rate, std, decay), instant = judged.moves, judged.rates(), judged.instant
            known = moves & (std > 0.0)
            holds = min(LOOKED, LED_OFF * float(np.min(estimate.std[known] / std[known], initial=np.inf)))
        if self.state.reference is None:
            self.state.reference = own().pi[m:]
        moved = np.where(moves[m:], estimate.pi[m:] - self.state.reference, 0.0)
        return DriftLine(moved, rate[m:], decay[m:], instant, instant + holds)

    @property
    def information(self) -> Information:
        """What the judged tracker knows of nuisances and parameters as they are now."""
        judged = self._chosen[0].tracker
        assert judged is not None
        return judged.information

    def refer(self, pi: Array) -> None:
        """Count what has moved from here on: parameters (n,)."""
        self.state.reference = pi

    def judged(self, own: Estimate, bias: NoiseBias, t: float) -> Estimate:
        """The session's estimate, of the first choice; see `readings`."""
        return self._reading(self._chosen[0], own, bias, t).estimate

    def readings(self, own: Estimate, bias: NoiseBias, t: float) -> tuple[Reading, ...]:
        """Each tracker's estimate at t, s, in the order of the choice.

        own: the estimate by the session's own least squares. bias: what noise in the columns does to it.
        """
        return tuple(self._reading(chosen, own, bias, t) for chosen in self._chosen)

    def _as_least_squares(self, tracker: Tracker) -> bool:
        """Whether a tracker has learned of no drift: what is known is then the session's own least squares."""
        return tracker is self.learned and not self.learned.moves.any() and self.state.since == np.inf

    def _reading(self, chosen: _Chosen, own: Estimate, bias: NoiseBias, t: float) -> Reading:
        tracker = chosen.tracker
        if tracker is None or self._as_least_squares(tracker):
            return Reading(chosen.choice.label, own, own.rows / self._rows_per_second)
        if isinstance(tracker, LearnedTrend):
            # Rows since an alarm wait until they show what it was; a drift may have ended with it, or grown.
            since = self.state.since if tracker is self.learned else np.inf
            estimate = tracker.estimate_at(t, max(0.0, t - since))
        else:
            estimate = tracker.estimate()
        # An estimate that was weighted against a prior stays as it is, see `unbiased`.
        if estimate.scale is None and not self._weighted and estimate.rows > 0.0:
            # Noise in the columns pulls every weighted mean of the rows alike; the scatter of that grows as rows fade.
            found = bias.correction(estimate.determined)
            fewer = max(1.0, bias.windows * self._rows_a_window / estimate.rows)
            covariance = estimate.covariance + fewer * (found.squares + found.uncertain)
            estimate = replace(estimate, pi=estimate.pi + found.shift, covariance=covariance)
        estimate = estimate.without_nuisances(self._nuisances)
        learned = tracker.found if isinstance(tracker, LearnedTrend) else ()
        drifts = tuple(replace(drift, column=drift.column - self._nuisances) for drift in learned)
        return Reading(chosen.choice.label, estimate, estimate.rows / self._rows_per_second, drifts)
