"""How the estimates of a session came about: each tracker's values with their covariance at instants of it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from sms_online.evaluation import Evaluation
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.observer import Observer
from sms_online.pipeline.snapshot import statistics_of
from sms_online.state import Stage, State
from sms_online.stream import Array
from sms_online.tables import finite
from sms_online.trackers.interface import Estimate
from sms_online.triangle import symmetric, upper

if TYPE_CHECKING:
    import pandas

# From one instant to the next to begin with, s, of so many parameters: one costs milliseconds. Of more it grows with
# their square. Where there are as many as are kept, every other one goes and the interval doubles.
FIRST_INTERVAL, FEW_PARAMETERS = 0.25, 48
# Where rows leave more than noise, an estimate with error bars from blocks of time takes as long as so many others.
MISFIT_FACTOR = 8.0
# Instants that are kept, at most; and numbers, 16 MB, for the covariance of many parameters is large.
MOST_INSTANTS, MOST_NUMBERS = 1200, 2_000_000
# Instants of results.json, which holds no covariances: as many as a plot can show.
MOST_WRITTEN = 200


@dataclass(frozen=True, eq=False)
class History:
    """One tracker's estimates over time.

    tracker: its name; judged: its estimate is the session's. parameters, units (n,): what is estimated. t (N,): s.
    estimate (N, n): in SI units, NaN of what the data did not determine then, or what was not estimated yet. upper
    (N, n (n + 1) / 2): upper triangle of its covariance, row by row, that of the reported standard deviations.
    """

    tracker: str
    judged: bool
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    t: Array
    estimate: Array
    upper: Array

    @property
    def std(self) -> Array:
        """Standard deviations (N, n), NaN of what was not determined."""
        i, j = np.triu_indices(len(self.parameters))
        return np.asarray(np.sqrt(self.upper[:, i == j]))

    @property
    def covariance(self) -> Array:
        """Covariance (N, n, n), NaN of what was not determined."""
        return symmetric(self.upper)

    def document(self) -> dict[str, Any]:
        """As results.json holds it: evenly thinned to `MOST_WRITTEN` instants, the last one kept."""
        step = max(1, -(-self.t.size // MOST_WRITTEN))
        rows = slice((self.t.size - 1) % step, None, step)
        columns = zip(self.parameters, self.estimate[rows].T.tolist(), self.std[rows].T.tolist(), strict=True)
        return {
            "tracker": self.tracker,
            "judged": self.judged,
            "t": self.t[rows].tolist(),
            "parameters": [
                {"name": name, "estimate": [*map(finite, values)], "std": [*map(finite, stds)]}
                for name, values, stds in columns
            ],
        }

    def columns(self) -> dict[str, Array]:
        """Columns of a table by name, each (N,).

        `t`, then for each parameter `<name>` and `<name>.std`, then `<name>~<name>`, the covariance of each pair.
        """
        out = {"t": self.t}
        for k, name in enumerate(self.parameters):
            out |= {name: self.estimate[:, k], f"{name}.std": self.std[:, k]}
        pairs = zip(*(index.tolist() for index in np.triu_indices(len(self.parameters))), self.upper.T, strict=True)
        return out | {f"{self.parameters[i]}~{self.parameters[j]}": column for i, j, column in pairs if i < j}

    def to_frame(self) -> pandas.DataFrame:
        """The `columns` as a table of pandas, indexed by t; ImportError where pandas is not installed."""
        try:
            import pandas
        except ImportError:
            raise ImportError("History.to_frame needs pandas, which is not installed: pip install pandas") from None
        return pandas.DataFrame(self.columns()).set_index("t")


def reported_covariance(estimate: Estimate, std: Array) -> Array:
    """Covariance (n, n) of an estimate with the deviations (n,) that are reported, NaN of what is not determined."""
    known = np.isfinite(std)
    # Where rows leave more than noise, reported deviations are larger than the stated noise makes them.
    scale = np.divide(std, estimate.std, out=np.ones_like(std), where=known & (estimate.std > 0.0))
    return np.asarray(np.where(np.outer(known, known), estimate.covariance, np.nan) * np.outer(scale, scale))


class HistoryState(State):
    """The instants of a session that are kept.

    instants: of each, t and how many parameters, then of each tracker their values and upper triangle of covariance.

    interval: from one to the next, s. due: time of the next one, s.
    """

    interval: float
    instants: list[Array] = msgspec.field(default_factory=list)
    due: float = -np.inf


class HistoryRecorder(Stage, Observer):
    """Looks at a session's estimates as its samples pass; put into `Estimator.observers`.

    It looks between internal blocks, so that the same samples give the same history however they are cut.
    """

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self.latest: tuple[float, Evaluation] | None = None  # the newest instant, s, and what was known then
        self.state = HistoryState(FIRST_INTERVAL * max(1.0, estimator.base.n / FEW_PARAMETERS) ** 2)

    def block_through(self) -> None:
        """See `Observer`."""
        t = self._estimator.state.through
        if t < self.state.due:
            return
        self._look(t)
        if len(self.state.instants) >= self._most:
            self.state.instants, self.state.interval = self.state.instants[::2], 2.0 * self.state.interval
        momentum = self._estimator.momentum
        interval = self.state.interval * (MISFIT_FACTOR if momentum is not None and momentum.misfit else 1.0)
        self.state.due = (t // interval + 1.0) * interval

    def finish(self) -> None:
        """The session's end, after the estimator has finished: the last instant is what the results say."""
        t = self._estimator.end
        if not np.isfinite(t):
            return
        if self.state.instants and self.state.instants[-1][0] == t:
            self.state.instants = self.state.instants[:-1]
        self._look(t)

    @property
    def _most(self) -> int:
        """Instants that are kept."""
        numbers = self._estimator.base.n * (self._estimator.base.n + 3) // 2 * len(self._estimator.trackers)
        return int(np.clip(MOST_NUMBERS // numbers, 2, MOST_INSTANTS))

    def _look(self, t: float) -> None:
        now = Evaluation(statistics_of(self._estimator, t))
        self.latest = t, now
        packed = [np.array((t, now.base.n))]
        for estimate, std in now.estimates:
            known = np.isfinite(std)
            packed += [np.where(known, estimate.pi, np.nan), upper(reported_covariance(estimate, std))]
        self.state.instants = [*self.state.instants, np.concatenate(packed)]

    @property
    def histories(self) -> tuple[History, ...]:
        """What each chosen tracker has said so far, the judged one first; none before the first instant."""
        instants, parameters = self.state.instants, self._estimator.base.parameters
        if not instants:
            return ()
        n, labels = len(parameters), [choice.label for choice in self._estimator.trackers]
        i, j = np.triu_indices(n)
        found = np.full((len(labels), len(instants), n + i.size), np.nan)
        first = 0
        # Fewer parameters before an event has added some; one tracker before the momentum balance gives the estimate.
        for _, alike in groupby(instants, key=lambda packed: (packed[1], packed.size)):
            rows = np.array(list(alike))
            known = int(rows[0, 1])
            columns = np.concatenate((np.arange(known), n + np.flatnonzero((i < known) & (j < known))))
            parts = rows[:, 2:].reshape(len(rows), -1, columns.size).transpose(1, 0, 2)
            found[: len(parts), first : first + len(rows), columns] = parts
            first += len(rows)
        t = np.array([packed[0] for packed in instants])
        names, units = tuple(p.name for p in parameters), tuple(p.unit for p in parameters)
        return tuple(
            History(label, k == 0, names, units, t, each[:, :n], each[:, n:])
            for k, (label, each) in enumerate(zip(labels, found, strict=True))
        )
