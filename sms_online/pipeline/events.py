"""Changes while a session runs: found by a sequential test of the momentum balance's windows.

Two statistics, both of the residuals against the estimate from the windows before:
- χ² of a window's rows over their own covariance, for what is large: two windows in a row that noise cannot explain;
- the cumulative sum of what χ² exceeds its expectation by (Page, Biometrika 41 (1954) 100), for what is small and
  lasts.
Rows whitened across windows would detect more, but their errors burst where the filter's width changes from one
window to the next, since what the two widths pass of the same noise differs in second order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from sms_online.model.parameters import Parameter
from sms_online.pipeline.latency import WANDER
from sms_online.pipeline.white_rows import WhiteRows
from sms_online.pipeline.whitening import forward_solved
from sms_online.state import Stage, State
from sms_online.stream import Array
from sms_online.trackers.factor import extended
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Prior, joined

# Motion before the first test, s, and after an event before the next: it must have shown what the model lacks.
WARM_UP = 4.0
# Windows that are remembered: an event is found and decided on within five seconds at the usual width.
REMEMBERED = 125
# So many windows in a row alarm where χ² of each exceeds its expectation by ALARM standard deviations √(2 n_v), one
# alone where it does so by LOUDEST, and the cumulative sum where it exceeds CUMULATIVE_ALARM of them; SLACK is taken
# off it at each window, and a window counts for CAPPED in it at most: what one window shows lasts for ten, until
# nothing of it is left in the next. The errors are Gaussian to first order only, so the limits are calibrated on steady
# runs (tests/campaigns/accuracy.py): there the largest of a run is 5 as a rule, 30 at worst, and the largest sum 20.
IN_A_ROW = 2
ALARM = 40.0
LOUDEST = 400.0
CUMULATIVE_ALARM = 100.0
CAPPED = 10.0
SLACK = 1.0
# The test sleeps where past rows leave more than this times their predicted variance: then the model lacks something,
# and what it lacks varies with the motion. Once the rows' covariance counts what it lacks, and for WARM_UP has, what is
# large alarms again.
LARGEST_LEVEL = 1.3

# Kind of an event behind which nothing has changed.
TRANSIENT = "transient"


@dataclass(frozen=True)
class Event:
    """A change of the system while the session ran.

    time: s. kind: `payload`, `stiffness`, `damping`, `friction`, `offset` or `inertia`; `unexplained` where no jump
    explains what followed, so that the estimate began anew; `undecided` where the session ended too early to decide, so
    that the estimate is that of before; `transient` where what acted has ended, and no parameter has changed; `effect`
    where one was added to the model. parameters: the names of
    what jumped, with unit, size and std (1σ) of each jump in that unit. dropped_windows: windows of rows, or spans of a
    smoother, that reach across the event or may, and were left out.
    """

    time: float
    kind: str
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    sizes: tuple[float, ...]
    stds: tuple[float, ...]
    dropped_windows: int


def prior_behind(events: Sequence[Event], described: Prior, parameters: Sequence[Parameter]) -> Prior:
    """What is known beforehand of parameters (n,) behind events: nothing of those that have jumped, or been added.

    described: of the system's own parameters, which come first.
    """
    more = np.full(len(parameters) - described.value.size, np.nan)
    whole = joined(described, Prior(more, more))
    jumped = {name for event in events for name in event.parameters}
    everything_jumped = any(event.kind == "unexplained" for event in events)
    gone = np.array([everything_jumped or p.name in jumped for p in parameters], dtype=np.bool_)
    return replace(whole, std=np.where(gone, np.nan, whole.std))


@dataclass(frozen=True)
class ClockShift:
    """The clock of a device, against the others, by which its samples are `size` ± `std` s later from `time` s on.

    That is no change of the system: a host that is busy with other work does so to its clocks.
    """

    time: float
    device: str
    size: float
    std: float


@dataclass(frozen=True)
class Seen:
    """A window that the test has seen: its rows before whitening across windows, and the information after it.

    end: grid index of its last sample. raw (n_v, n + 1), covariance (n_v, n_v), misfit (n_v,): as in WhiteRows. known:
    information of all rows taken in up to and with this window.
    """

    end: int
    raw: Array
    covariance: Array
    misfit: Array
    known: Information


class DetectorState(State):
    """What a test keeps of the windows that it has seen, and its sums.

    known, history, alarm, onset: see `ChangeDetector`. shown: windows in which the arm moved. tested: windows; levels:
    sum of their χ² / n_v, none for more than the cumulative sum counts it; level: what the next ones are measured by.
    sum: the cumulative sum. loud: windows in a row beyond ALARM. lacking: windows in a row since the model is known to
    lack something. moved (n,): drift that rows of now are free of, None where there is none.
    """

    known: Information
    history: list[Seen] = msgspec.field(default_factory=list)
    alarm: int | None = None
    onset: int = -1
    shown: int = 0
    tested: int = 0
    level: float = 1.0
    levels: float = 0.0
    sum: float = 0.0
    loud: int = 0
    lacking: int = 0
    moved: Array | None = None


class ChangeDetector(Stage):
    """Sequential test of windows against the estimate before them.

    hop: from one window to the next, s. remembered: windows. clocks: columns of those that wander.
    """

    def __init__(self, n: int, n_v: int, hop: float, remembered: int = REMEMBERED, clocks: Sequence[int] = ()) -> None:
        self._n_v, self._remembered, self._clocks = n_v, remembered, list(clocks)
        self._warm_up = round(WARM_UP / hop)
        self.begin(Information.none(n))

    def begin(self, known: Information) -> None:
        """Start, or continue after an event, with what is known by then."""
        self.state = DetectorState(known)

    @property
    def known(self) -> Information:
        """Information of the rows taken in."""
        return self.state.known

    @property
    def history(self) -> list[Seen]:
        """The last windows, oldest first."""
        return self.state.history

    @property
    def alarm(self) -> int | None:
        """Grid index that an event is surely before, None while nothing has changed."""
        return self.state.alarm

    @property
    def uncertain(self) -> bool:
        """Whether what the model lacked before may be behind an alarm too."""
        return self.state.lacking > 0

    def dismiss(self) -> None:
        """Nothing has changed: go on with what was known before the alarm, as at the beginning."""
        self.begin(self.known)

    @property
    def onset(self) -> int:
        """Grid index of the last window that is surely undisturbed."""
        return self.state.onset

    def push(self, rows: WhiteRows, misfit: bool) -> bool:
        """Test a window; whether to take its rows in: not from an alarm on.

        misfit: the model lacks something already, and what it lacks varies with the motion: only what is large alarms.
        """
        if self.state.alarm is None:
            self._test(rows, misfit)
        if self.state.alarm is None:
            self.state.known = self.state.known.with_rows(rows.Y)
        seen = Seen(rows.end, rows.raw, rows.covariance, rows.misfit, self.state.known)
        self.state.history = [*self.state.history, seen][-self._remembered :]
        return self.state.alarm is None

    def _test(self, rows: WhiteRows, misfit: bool) -> None:
        self.state.lacking = self.state.lacking + 1 if misfit else 0
        excess = self._excess(rows)
        self.state.shown += rows.moves
        young = self.state.shown <= self._warm_up or 0 < self.state.lacking <= self._warm_up
        if young or (self.state.level > LARGEST_LEVEL and not misfit):
            self.state.sum, self.state.loud = 0.0, 0
            return
        if self.state.sum == 0.0:
            self.state.onset = self.state.history[-1].end
        # What the model lacks lasts as well.
        self.state.sum = 0.0 if misfit else max(0.0, self.state.sum + min(excess, CAPPED) - SLACK)
        self.state.loud = self.state.loud + 1 if excess > ALARM else 0
        loud = self.state.loud == IN_A_ROW or excess > LOUDEST
        if loud:
            self.state.onset = self.state.history[-IN_A_ROW].end
        if loud or self.state.sum > CUMULATIVE_ALARM:
            self.state.alarm = rows.end

    def _excess(self, rows: WhiteRows) -> float:
        """χ² of the window less its expectation, in standard deviations √(2 n_v)."""
        late = WANDER * rows.raw[:, self._clocks]
        L = np.asarray(np.linalg.cholesky(rows.covariance + late @ late.T), dtype=np.float64)
        own = forward_solved(L, rows.raw)
        # What the rows add to the residual sum of squares is χ² of their innovations, with the estimate's own
        # uncertainty counted; directions that nothing is known of add nothing.
        known = self.state.known.factor.copy()
        known[-1, -1] = 0.0
        chi2 = float(extended(known, own)[-1, -1] ** 2)
        if self.state.sum == 0.0:
            # What may be an event is measured by what was before it.
            self.state.level = max(1.0, self.state.levels / max(1, self.state.tested))
        deviation = np.sqrt(2.0 / self._n_v)
        self.state.tested += 1
        self.state.levels += min(chi2 / self._n_v, 1.0 + CAPPED * deviation)
        return float((chi2 / self._n_v / self.state.level - 1.0) / deviation)

    def seen(self) -> list[Seen]:
        """The last windows, oldest first, with the drift that was subtracted from their rows."""
        moved = self.state.moved
        if moved is None:
            return list(self.state.history)
        out = []
        for seen in self.state.history:
            raw = seen.raw.copy()
            raw[:, -1] += raw[:, :-1] @ moved
            out.append(replace(seen, raw=raw, known=seen.known.shifted(moved)))
        return out

    def before(self, end: int) -> Seen:
        """The last window that ends at or before a grid index, the oldest where that is forgotten."""
        windows = self.seen()
        earlier = [seen for seen in windows if seen.end <= end]
        return earlier[-1] if earlier else windows[0]

    def follow(self, known: Information, moved: Array) -> None:
        """Test against what a tracker knows of parameters that drift, less the drift (n,) that rows are free of."""
        self.state.known, self.state.moved = known, moved
