"""Energy balance in streaming form, (42)–(45): integrals at sensor rate, rows thinned afterwards."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.polynomial import Polynomial

from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices

# Rows a second: the balance's own frequencies stay below some 20 Hz; denser rows repeat each other's noise.
ROW_RATE = 50.0
# Rows are differences to the first instant of a window, the paper's form. Integrated noise grows without bound, so a
# new window begins after this time, s; it holds several periods of an exciting trajectory, and the whole of the
# paper's.
WINDOW = 30.0
# Samples on each side in the interpolation that is integrated: degree 7, no worse than the eighth-order rates.
SIDE = 4


def interval_weights() -> Array:
    """Weights (2 SIDE,) of samples -SIDE+1 … SIDE in the integral over one sample interval, from 0 to 1."""
    nodes = np.arange(1 - SIDE, SIDE + 1)
    weights = np.zeros(nodes.size)
    for k, node in enumerate(nodes):
        basis = Polynomial.fromroots(np.delete(nodes, k))
        primitive = (basis / basis(node)).integ()
        weights[k] = primitive(1.0) - primitive(0.0)
    return weights


@dataclass(frozen=True)
class BalanceRows:
    """Rows Y β = b: Y (M, n), b (M,), and the grid index (M,) of the instant that each ends at."""

    Y: Array
    b: Array
    index: Indices


class SharedErrors(State):
    """What the errors that rows of a window share do to a least-squares estimate, which takes them for independent.

    All rows of a window are differences to its first instant and share that instant's error. The noise of the measured
    torque is integrated into the work, a random walk: what it adds between two rows is in all later rows of the
    window. An error e that enters every row from row j on moves the estimate by Λ⁻¹ S_j e, Λ = YᵀY, with S_j the sum
    of the window's rows from j on. So the start adds var(e_0) Λ⁻¹ S_1 S_1ᵀ Λ⁻¹ to the covariance, the walk Σ_j q_j S_j
    S_jᵀ in place of S_1 S_1ᵀ, with q_j the variance of the work's noise since the row before.

    starts (n, n): Σ S_1 S_1ᵀ over finished windows; walks (n, n): Σ q_j S_j S_jᵀ. S_j = S_1 - P_j with P_j the sum of
    the rows before j, so of the open window there is S_1 as `sum` (n,), Σ q_j, Σ q_j P_j and Σ q_j P_j P_jᵀ.
    """

    starts: Array
    walks: Array
    sum: Array
    qP: Array
    qPP: Array
    q: float = 0.0
    rows: int = 0

    @staticmethod
    def none(n: int) -> SharedErrors:
        """Sums of no rows of n parameters."""
        starts, walks, qPP = np.zeros((3, n, n))
        total, qP = np.zeros((2, n))
        return SharedErrors(starts, walks, total, qP, qPP)

    def add(self, Y: Array, q: Array) -> None:
        """Rows (M, n) of the open window and the variance (M,) of the work's noise since the row before each, J²."""
        before = self.sum + np.concatenate((np.zeros((1, Y.shape[1])), np.cumsum(Y, axis=0)[:-1]))
        self.q += float(q.sum())
        self.qP = self.qP + q @ before
        self.qPP = self.qPP + (before * q[:, None]).T @ before
        self.sum = self.sum + Y.sum(axis=0)
        self.rows += Y.shape[0]

    def _open_walk(self) -> Array:
        cross = np.outer(self.sum, self.qP)
        return np.asarray(self.q * np.outer(self.sum, self.sum) - cross - cross.T + self.qPP)

    def close(self) -> None:
        """The next rows belong to another window."""
        self.starts = self.starts + np.outer(self.sum, self.sum)
        self.walks = self.walks + self._open_walk()
        self.q, self.sum = 0.0, np.zeros_like(self.sum)
        self.qP, self.qPP = np.zeros_like(self.qP), np.zeros_like(self.qPP)

    def variance(self, inverse: Array, start_variance: float) -> Array:
        """Variance (n,) that shared errors add, from Λ⁻¹ (n, n) and var(e_0), J²."""
        starts = self.starts + np.outer(self.sum, self.sum)
        shared = start_variance * starts + self.walks + self._open_walk()
        # Differences of moments may round below zero where there is nothing.
        return np.asarray(np.maximum(0.0, np.einsum("ij,jk,ik->i", inverse, shared, inverse)))


class EnergyState(State):
    """What an energy balance keeps of its segment.

    x (B, n_x), v (B, n_v), power (B, columns + 1): of the last 2 SIDE - 1 samples; the instant up to which the
    integral is known is number SIDE - 1 of them. instant: its number in the segment. row_noise: variance of the work's
    noise up to the last row. window_start: balance at the window's first instant.
    """

    x: Array
    v: Array
    power: Array
    integral: Array
    instant: int = 0
    row_noise: float = 0.0
    window_start: Array | None = None


class EnergyBalance(Stage):
    """Turns consecutive samples of positions, speeds and torques into rows of (44), in J."""

    def __init__(self, model: Model, base: BaseParameters, sample_rate: float) -> None:
        self.model = model
        self.base = base
        self.sample_rate = sample_rate
        self.stride = max(1, round(sample_rate / ROW_RATE))
        self.window = self.stride * round(WINDOW * sample_rate / self.stride)
        self._weights = interval_weights() / sample_rate
        # What is integrated: the columns that dissipate, then the work of the motors.
        self._columns = [*model.dissipative, model.n_pi]
        self.shared = SharedErrors.none(base.n)
        self.begin_segment()

    def begin_segment(self) -> None:
        """Forget the samples before a gap; a new window starts with the next ones."""
        layout = self.model.layout
        integral = np.zeros(len(self._columns) + 1)
        x, v, power = (np.empty((0, columns)) for columns in (layout.n_x, layout.n_v, integral.size))
        self.state = EnergyState(x, v, power, integral)
        self.shared.close()

    def push(
        self,
        index: Indices,
        x: Array,
        v: Array,
        signals: Array,
        input_noise: Array,
    ) -> BalanceRows:
        """Rows that B consecutive samples complete: grid index (B,), x (B, n_x), v (B, n_v).

        signals (B, n_signals). input_noise (inputs,): white noise of n τ and of measured wrenches, 1σ per sample.
        """
        motor_rates = v[:, list(self.model.layout.theta_m)]
        work = np.einsum("bj,bj->b", signals[:, : motor_rates.shape[1]], motor_rates)
        # Rates along which the inputs work. The work of wrenches is what they take out, with the effects'.
        rates = motor_rates if self.model.wrenches is None else (v[:, None] @ self.model.input_columns(x))[:, 0]
        # The last column gathers the variance of the work's noise; its rate is per sample, not per second.
        noise = (rates**2 @ input_noise**2) / self.sample_rate
        taken = self.model.power_columns(x, v, self.model.inputs(signals))
        power = np.column_stack((taken[:, self._columns[:-1]], work, noise))
        x, v = np.concatenate((self.state.x, x)), np.concatenate((self.state.v, v))
        power = np.concatenate((self.state.power, power))
        kept = 2 * SIDE - 1
        intervals = max(0, power.shape[0] - kept)
        self.state.x, self.state.v, self.state.power = x[-kept:], v[-kept:], power[-kept:]
        if intervals == 0:
            return self._rows(np.empty((0, self.model.n_pi + 1)), index[:0])
        steps = sliding_window_view(power, 2 * SIDE, axis=0) @ self._weights
        integral = np.cumsum(np.concatenate((self.state.integral[None], steps)), axis=0)
        instants = self.state.instant + np.arange(intervals + 1)
        fresh = instants >= (0 if self.state.window_start is None else self.state.instant + 1)
        chosen = np.flatnonzero(fresh & (instants % self.stride == 0))
        balance = np.zeros((chosen.size, self.model.n_pi + 1))
        if chosen.size:
            balance[:, :-1] = self.model.energy_columns(x[SIDE - 1 + chosen], v[SIDE - 1 + chosen])
        balance[:, self._columns] += integral[chosen, :-1]
        self.state.integral, self.state.instant = integral[-1], int(instants[-1])
        q = np.diff(integral[chosen, -1], prepend=self.state.row_noise)
        if chosen.size:
            self.state.row_noise = float(integral[chosen[-1], -1])
        grid = index[-1] - SIDE + 1 - intervals + chosen
        differences = np.empty_like(balance)
        # A segment's first instant is no row: it is what the others are compared with.
        reported = np.arange(1 if self.state.window_start is None else 0, chosen.size)
        start = balance[0] if self.state.window_start is None and chosen.size else self.state.window_start
        closes = instants[chosen] % self.window == 0
        for rows in np.split(reported, np.flatnonzero(closes[reported]) + 1):
            if rows.size and start is not None:
                differences[rows] = balance[rows] - start
                self.shared.add(self.base.columns(differences[rows, :-1]), q[rows])
                if closes[rows[-1]]:
                    # The last instant of a window is the first of the next.
                    start = balance[rows[-1]]
                    self.shared.close()
        self.state.window_start = start
        return self._rows(differences[reported], grid[reported])

    def _rows(self, differences: Array, ends: Indices) -> BalanceRows:
        columns = differences[:, :-1]
        b = differences[:, -1] - self.base.known_part(columns)
        return BalanceRows(self.base.columns(columns), b, ends)
