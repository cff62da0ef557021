"""Changes while a session runs: found by a sequential test of the momentum balance's windows.

Two statistics, both of the residuals against the estimate from the windows before:
- χ² of a window's rows over their own covariance, for what is large: two windows in a row that noise cannot explain;
- the cumulative sum of what χ² exceeds its expectation by (Page, Biometrika 41 (1954) 100), for what is small and
  lasts.
Rows that are whitened across windows would tell more, but their errors burst where the filter's width changes from one
window to the next, since what the two widths pass of the same noise differs in second order.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sms_online.pipeline.momentum_fit import WhiteRows
from sms_online.stream import Array
from sms_online.trackers.factor import triangular_factor
from sms_online.trackers.information import Information

# Time before the first test, s, and after an event before the next: a motion must have shown what the model lacks.
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
# and what it lacks varies with the motion.
LARGEST_LEVEL = 1.3


@dataclass(frozen=True)
class Event:
    """A change of the system while the session ran.

    time: s. kind: `payload`, `stiffness`, `damping`, `friction`, `offset` or `inertia`; `unexplained` where no jump
    explains what followed, so that the estimate began anew; `undecided` where the session ended too early to tell, so
    that the estimate is that of before; `effect` where one that the model lacked was taken up. parameters: the names of
    what jumped, with unit, size and std (1σ) of each jump in that unit. dropped_windows: windows of rows that reach
    across the event and were left out.
    """

    time: float
    kind: str
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    sizes: tuple[float, ...]
    stds: tuple[float, ...]
    dropped_windows: int

    @staticmethod
    def from_saved(entry: dict[str, Any]) -> Event:
        """The event of which `entry` is dataclasses.asdict, read back from JSON."""
        fields: dict[str, Any] = {k: tuple(value) if isinstance(value, list) else value for k, value in entry.items()}
        return Event(**fields)


@dataclass(frozen=True)
class Seen:
    """A window that the test has seen: its rows before whitening across windows, and the information after it.

    end: grid index of its last sample. raw (n_v, n + 1), covariance (n_v, n_v): as in WhiteRows. known: information of
    all rows taken in up to and with this window.
    """

    end: int
    raw: Array
    covariance: Array
    known: Information


class ChangeDetector:
    """Sequential test of windows against the estimate before them.

    hop: from one window to the next, s. known: information of the rows taken in. history: the last windows, oldest
    first. alarm: grid index that an event is surely before, None while nothing has changed. onset: grid index of the
    last window that is surely undisturbed.
    """

    def __init__(self, n: int, n_v: int, hop: float) -> None:
        self._n_v = n_v
        self._warm_up = round(WARM_UP / hop)
        self.begin(Information.none(n))

    def begin(self, known: Information) -> None:
        """Start, or continue after an event, with what is known by then."""
        self.known = known
        self.history: deque[Seen] = deque(maxlen=REMEMBERED)
        self.alarm: int | None = None
        self.onset = -1
        self._tested = 0
        self._level = 1.0
        self._levels = 0.0  # sum of the tested windows' χ² / n_v, none for more than the cumulative sum counts it
        self._sum = 0.0
        self._loud = 0  # windows in a row beyond ALARM

    def push(self, rows: WhiteRows, misfit: bool) -> bool:
        """Test a window; whether to take its rows in: not from an alarm on.

        misfit: the model lacks something already, and what it lacks varies with the motion: the test sleeps.
        """
        if self.alarm is None:
            self._test(rows, misfit)
        if self.alarm is None:
            self.known = self.known.with_rows(rows.Y)
        self.history.append(Seen(rows.end, rows.raw, rows.covariance, self.known))
        return self.alarm is None

    def _test(self, rows: WhiteRows, misfit: bool) -> None:
        excess = self._excess(rows)
        if misfit or self._tested <= self._warm_up or excess is None:
            self._sum, self._loud = 0.0, 0
            return
        if self._sum == 0.0:
            self.onset = self.history[-1].end
        self._sum = max(0.0, self._sum + min(excess, CAPPED) - SLACK)
        self._loud = self._loud + 1 if excess > ALARM else 0
        loud = self._loud == IN_A_ROW or excess > LOUDEST
        if loud:
            self.onset = self.history[-IN_A_ROW].end
        if loud or self._sum > CUMULATIVE_ALARM:
            self.alarm = rows.end

    def _excess(self, rows: WhiteRows) -> float | None:
        """χ² of the window less its expectation, in standard deviations √(2 n_v); None where the test sleeps."""
        L = np.linalg.cholesky(rows.covariance)
        own = scipy.linalg.solve_triangular(L, rows.raw, lower=True, check_finite=False)
        # What the rows add to the residual sum of squares is χ² of their innovations, with the estimate's own
        # uncertainty counted; directions that nothing is known of add nothing.
        known = self.known.factor.copy()
        known[-1, -1] = 0.0
        chi2 = float(triangular_factor(known, own)[-1, -1] ** 2)
        if self._sum == 0.0:
            # What may be an event is measured by what was before it.
            self._level = max(1.0, self._levels / max(1, self._tested))
        deviation = np.sqrt(2.0 / self._n_v)
        self._tested += 1
        self._levels += min(chi2 / self._n_v, 1.0 + CAPPED * deviation)
        return None if self._level > LARGEST_LEVEL else float((chi2 / self._n_v / self._level - 1.0) / deviation)

    def before(self, end: int) -> Seen | None:
        """The last window that ends at or before a grid index; None where it is forgotten."""
        earlier = [seen for seen in self.history if seen.end <= end]
        return earlier[-1] if earlier else None

    def state(self) -> dict[str, Any]:
        """What `restore` needs to continue."""
        n1, alarm = len(self.known.factor), -1 if self.alarm is None else self.alarm
        return {
            "factor": self.known.factor,
            "numbers": np.array([self.known.rows, alarm, self.onset, self._tested, self._loud]),
            "sums": np.array([self._sum, self._level, self._levels]),
            "seen_end": np.array([(seen.end, seen.known.rows) for seen in self.history], dtype=np.int64).reshape(-1, 2),
            "seen_raw": np.array([seen.raw for seen in self.history]).reshape(-1, self._n_v, n1),
            "seen_covariance": np.array([s.covariance for s in self.history]).reshape(-1, self._n_v, self._n_v),
            "seen_factor": np.array([seen.known.factor for seen in self.history]).reshape(-1, n1, n1),
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a saved state."""
        rows, alarm, self.onset, self._tested, self._loud = (int(number) for number in state["numbers"])
        self.known = Information(np.array(state["factor"]), rows)
        self.alarm = None if alarm < 0 else alarm
        self._sum, self._level, self._levels = (float(number) for number in state["sums"])
        entries = zip(state["seen_end"], state["seen_raw"], state["seen_covariance"], state["seen_factor"], strict=True)
        self.history = deque(
            (
                Seen(int(end), np.array(raw), np.array(C), Information(np.array(factor), int(rows)))
                for (end, rows), raw, C, factor in entries
            ),
            maxlen=REMEMBERED,
        )
