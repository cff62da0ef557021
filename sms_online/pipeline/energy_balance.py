"""Energy balance in streaming form, (42)–(45): integrals at sensor rate, rows thinned afterwards."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.stream import Array

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
    """Rows Y β = b: Y (M, n), b (M,), and the grid index (M,) of the last sample behind each."""

    Y: Array
    b: Array
    index: NDArray[np.int64]


class SharedStarts:
    """What the error of each window's first instant does to an estimate.

    All rows of a window are differences to one instant, whose error they share: the rows' errors have covariance
    σ² (1 + 1 1ᵀ) in a window. Least squares takes them for independent; the shared part adds σ² (Λ⁻¹ g)(Λ⁻¹ g)ᵀ to its
    covariance, Λ = YᵀY, with g the sum of the window's rows.
    """

    def __init__(self, n: int) -> None:
        self.closed = np.zeros((n, n))  # Σ g gᵀ over finished windows
        self.sum = np.zeros(n)  # g of the window that is open

    def add(self, Y: Array) -> None:
        """Rows (M, n) of the open window."""
        self.sum = self.sum + Y.sum(axis=0)

    def close(self) -> None:
        """The next rows belong to another window."""
        self.closed = self.closed + np.outer(self.sum, self.sum)
        self.sum = np.zeros_like(self.sum)

    def variance(self, inverse: Array) -> Array:
        """Variance (n,) of each parameter for σ = 1, from Λ⁻¹ (n, n)."""
        spread = inverse @ (self.closed + np.outer(self.sum, self.sum)) @ inverse
        return np.asarray(np.diag(spread))


class EnergyBalance:
    """Turns consecutive samples of positions, speeds and torques into rows of (44), in J."""

    def __init__(self, model: Model, base: BaseParameters, sample_rate: float) -> None:
        self.model = model
        self.base = base
        self.stride = max(1, round(sample_rate / ROW_RATE))
        self.window = self.stride * round(WINDOW * sample_rate / self.stride)
        self._weights = interval_weights() / sample_rate
        # What is integrated: the columns that dissipate, then the work of the motors.
        self._columns = [*model.dissipative, model.n_pi]
        self.starts = SharedStarts(base.n)
        self.begin_segment()

    def begin_segment(self) -> None:
        """Forget the samples before a gap; a new window starts with the next ones."""
        layout = self.model.layout
        # The last 2 SIDE - 1 samples; the instant up to which the integral is known is number SIDE - 1 of them.
        self._x, self._v = np.empty((0, layout.n_x)), np.empty((0, layout.n_v))
        self._power = np.empty((0, len(self._columns)))
        self._integral = np.zeros(len(self._columns))
        self._instant = 0  # number of that instant in its segment
        self._window_start: Array | None = None  # balance at the window's first instant
        self.starts.close()

    def push(self, index: NDArray[np.int64], x: Array, v: Array, joint_torque: Array) -> BalanceRows:
        """Rows that B consecutive samples complete: grid index (B,), x (B, n_x), v (B, n_v), n τ (B, joints)."""
        work = np.einsum("bj,bj->b", joint_torque, v[:, list(self.model.layout.theta_m)])
        power = np.concatenate((self.model.power_columns(x, v)[:, self._columns[:-1]], work[:, None]), axis=1)
        x, v = np.concatenate((self._x, x)), np.concatenate((self._v, v))
        power = np.concatenate((self._power, power))
        kept = 2 * SIDE - 1
        intervals = max(0, power.shape[0] - kept)
        self._x, self._v, self._power = x[-kept:], v[-kept:], power[-kept:]
        if intervals == 0:
            return self._rows(np.empty((0, self.model.n_pi + 1)), index[:0])
        steps = sliding_window_view(power, 2 * SIDE, axis=0) @ self._weights
        integral = np.cumsum(np.concatenate((self._integral[None], steps)), axis=0)
        instants = self._instant + np.arange(intervals + 1)
        fresh = instants >= (0 if self._window_start is None else self._instant + 1)
        chosen = np.flatnonzero(fresh & (instants % self.stride == 0))
        balance = np.zeros((chosen.size, self.model.n_pi + 1))
        if chosen.size:
            balance[:, :-1] = self.model.energy_columns(x[SIDE - 1 + chosen], v[SIDE - 1 + chosen])
        balance[:, self._columns] += integral[chosen]
        self._integral, self._instant = integral[-1], int(instants[-1])
        grid = index[-1] - SIDE - intervals + chosen
        differences = np.empty_like(balance)
        reported = slice(1 if self._window_start is None else 0, None)
        start = balance[0] if self._window_start is None and chosen.size else self._window_start
        closes = instants[chosen] % self.window == 0
        for rows in np.split(np.arange(chosen.size), np.flatnonzero(closes) + 1):
            if rows.size and start is not None:
                differences[rows] = balance[rows] - start
                self.starts.add(self.base.columns(differences[rows, :-1]))
                if closes[rows[-1]]:
                    # The last instant of a window is the first of the next.
                    start = balance[rows[-1]]
                    self.starts.close()
        self._window_start = start
        return self._rows(differences[reported], grid[reported])

    def _rows(self, differences: Array, ends: NDArray[np.int64]) -> BalanceRows:
        columns = differences[:, :-1]
        b = differences[:, -1] - self.base.known_part(columns)
        return BalanceRows(self.base.columns(columns), b, ends)

    def state(self) -> dict[str, Array | int]:
        """What `restore` needs to continue."""
        start = np.empty(0) if self._window_start is None else self._window_start
        return {
            "x": self._x, "v": self._v, "power": self._power, "integral": self._integral,
            "instant": self._instant, "window_start": start,
            "closed": self.starts.closed, "sum": self.starts.sum,
        }  # fmt: skip

    def restore(self, state: dict[str, Array]) -> None:
        """Continue from a saved state."""
        self._x, self._v, self._power = state["x"], state["v"], state["power"]
        self._integral, self._instant = state["integral"], int(state["instant"])
        self._window_start = state["window_start"] if state["window_start"].size else None
        self.starts.closed, self.starts.sum = state["closed"], state["sum"]
