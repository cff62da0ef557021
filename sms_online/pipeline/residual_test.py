"""Do the rows leave more than noise? A sequential test of every coordinate and row type of the momentum balance.

The rows of a window are compared with the estimate from windows that ended before it began, so that the two share no
sample: of e = b - Y β̂ the covariance is C + Y P Yᵀ, C what the sensors' noise makes of
the rows and P that of β̂. Where nothing but noise is
left e² over its variance is χ². A variance v₁ of e against a variance v₀, both in units of that, has the log likelihood
ratio ½ χ² (1/v₀ - 1/v₁) - ½ ν log(v₁/v₀) for ν coordinates, and its cumulative sum, never below zero, alarms beyond h.

The expectation of its exponential is 1 at the variance v₀ and less below it, so that the mean number of independent
windows to a false alarm is at least eʰ; a cap on what one window counts only adds to it. Windows overlap, so every sum
takes one window in HOPS: there are HOPS of them for every test, and their rates add. Hence h for a stated rate.
Sources: Page, Biometrika 41 (1954) 100; Lorden, Annals of Mathematical Statistics 42 (1971) 1897 (the bound).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sms_online.calibration.nuisance import BOUND, Nuisance
from sms_online.calibration.release import at_most_tolerances, release_gain
from sms_online.model.layout import Layout
from sms_online.pipeline.latency import WANDER
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.pipeline.persistence import Persistence
from sms_online.pipeline.white_rows import WhiteRows
from sms_online.row_types import row_types
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices

# False alarms an hour, at most: one in a hundred hours of motion.
FALSE_ALARMS = 0.01
# Variance that noise may have at most, for it is known to a tenth; and the one that the test is best for: twice the
# deviation.
NOISE, WANTED = 1.1**2, 2.0**2
# So many windows that share no sample alarm at least: errors of second order burst for one or two in a row.
LEAST_WINDOWS = 3
# Singular values below this share of the largest, of columns scaled to unit length: nothing is known of a direction.
RANK_TOLERANCE = 1e-10
# A row that has more than this share of itself in such directions is not tested.
KNOWN = 1e-6


@dataclass(frozen=True)
class Alarm:
    """Rows leave more than noise: type of the row that leaves most.

    end: grid index of the last window behind it. since: grid index of the last window's end that showed nothing.
    """

    row: str
    end: int
    since: int


class TestState(State):
    """What a test keeps of its windows.

    sums (HOPS, tests): the coordinates', then the types'. since: window's end at which each sum was zero last.
    waiting (n + 1, n + 1): factor that the next estimate is made of. beta, scale (n,), root (n, rank), null (n, ·): the
    estimate, and directions that are known and unknown, columns scaled to unit length.
    """

    sums: Array
    since: Indices
    beta: Array
    scale: Array
    root: Array
    null: Array
    waiting: Array | None = None
    windows: int = 0
    alarm: Alarm | None = None


class SequentialTest(Stage):
    """Tests the windows of a session, in order, until the first alarm; persistence: of what joints' rows leave.

    hop: time from one window to the next, s. limit: h. nuisances: those whose columns come before the parameters'.
    Their tolerances count as `BOUND` times as wide: what they explain beyond their tolerances is reported as such.
    clocks: which of them are clocks that wander.
    """

    def __init__(
        self, layout: Layout, hop: float, nuisances: Sequence[Nuisance] = (), clocks: Sequence[int] = ()
    ) -> None:
        self._layout, self._clocks = layout, list(clocks)
        tolerances = np.array([each.tolerance if each.may_give_way else np.inf for each in nuisances])
        self._loose: Indices = np.flatnonzero(np.isfinite(tolerances))
        self._tolerances: Array = tolerances[self._loose]
        self._types = {name: speeds for name, speeds in row_types(layout).items() if len(speeds) > 1}
        tests = layout.n_v + len(self._types)
        self.limit = float(np.log(tests * 3600.0 / hop / FALSE_ALARMS))
        self.persistence = Persistence()
        nothing = np.zeros(0), np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0))
        self.state = TestState(np.zeros((HOPS, tests)), np.full((HOPS, tests), -1, dtype=np.int64), *nothing)

    @property
    def alarm(self) -> Alarm | None:
        """None while all is noise."""
        return self.state.alarm

    def push(self, rows: WhiteRows, factor: Array, variance: float = 1.0) -> None:
        """Test a window; factor (n + 1, n + 1): information of the rows before it.

        variance: that noise may have at most, over the predicted one, beside `NOISE`.
        """
        turn = self.state.windows % HOPS
        if turn == 0:
            self._know(factor if self.state.waiting is None else self.state.waiting)
            self.state.waiting = factor
        self.state.windows += 1
        self.persistence.push(rows.raw[list(self._layout.theta_m)])
        if self.state.alarm is not None:
            return
        ratios = self._log_likelihood(rows, variance)
        now, before = self.state, self.state.since[turn]
        sums = np.maximum(0.0, now.sums[turn] + np.minimum(ratios, self.limit / LEAST_WINDOWS))
        now.sums, now.since = now.sums.copy(), now.since.copy()
        now.sums[turn] = sums
        now.since[turn] = np.where((sums == 0.0) | (before < 0), rows.end, before)
        worst = int(np.argmax(sums))
        if sums[worst] > self.limit:
            self.state.alarm = Alarm(self._row(worst), rows.end, int(self.state.since[turn, worst]))

    def _know(self, factor: Array) -> None:
        """Take β̂ from a factor; null holds the directions of which it knows nothing, columns scaled to unit length."""
        n = len(factor) - 1
        norm = np.linalg.norm(factor[:, :n], axis=0)
        self.state.scale = scale = np.where(norm > 0.0, norm, 1.0)
        U, s, Vt = np.linalg.svd(factor[:, :n] / scale, full_matrices=False)
        rank = int(np.count_nonzero(s > RANK_TOLERANCE * max(float(s[0]), 1.0)))
        self.state.root = Vt[:rank].T / s[:rank] / scale[:, None]
        self.state.beta = self.state.root @ (U[:, :rank].T @ factor[:, -1])
        self.state.null = Vt[rank:].T
        if self._loose.size:
            self._loosen()

    def _loosen(self) -> None:
        now, unit = self.state, self._tolerances
        C = now.root @ now.root[self._loose].T / unit
        gain = release_gain(at_most_tolerances(C[self._loose] / unit[:, None]), np.full(unit.size, BOUND**-2))
        size, axes = np.linalg.eigh(0.5 * (gain + gain.T))
        now.beta = now.beta + C @ (gain @ (now.beta[self._loose] / unit))
        now.root = np.concatenate((now.root, C @ (axes * np.sqrt(np.maximum(size, 0.0)))), axis=1)

    def _log_likelihood(self, rows: WhiteRows, variance: float) -> Array:
        """Log likelihood ratio of every test (tests,); zero where nothing is known."""
        Y, n_v = rows.raw[:, :-1], self._layout.n_v
        e = rows.raw[:, -1] - Y @ self.state.beta
        spread = np.concatenate((Y @ self.state.root, WANDER * Y[:, self._clocks]), axis=1)
        S = variance * rows.noise + spread @ spread.T
        scaled = Y / self.state.scale
        tested = np.linalg.norm(scaled @ self.state.null, axis=1) <= KNOWN * np.linalg.norm(scaled, axis=1)
        out = np.zeros(n_v + len(self._types))
        out[:n_v] = np.where(tested, _ratio(e**2 / np.diag(S), 1), 0.0)
        for k, speeds in enumerate(self._types.values(), start=n_v):
            own = [speed for speed in speeds if tested[speed]]
            if own:
                chi2 = float(e[own] @ np.linalg.solve(S[np.ix_(own, own)], e[own]))
                out[k] = _ratio(chi2, len(own))
        return out

    def _row(self, test: int) -> str:
        """Row type of a test."""
        if test >= self._layout.n_v:
            return list(self._types)[test - self._layout.n_v]
        return next(name for name, speeds in row_types(self._layout).items() if test in speeds)

    @property
    def evidence(self) -> dict[str, float]:
        """By row type, the largest sum over its limit: 1 alarms."""
        n_v, shares = self._layout.n_v, self.state.sums.max(axis=0) / self.limit
        out = {name: float(shares[speeds].max()) for name, speeds in row_types(self._layout).items()}
        for k, name in enumerate(self._types, start=n_v):
            out[name] = max(out[name], float(shares[k]))
        return out


def _ratio(chi2: Any, freedom: int) -> Any:
    """Log likelihood ratio of the variance WANTED against NOISE."""
    return 0.5 * chi2 * (1.0 / NOISE - 1.0 / WANTED) - 0.5 * freedom * np.log(WANTED / NOISE)
