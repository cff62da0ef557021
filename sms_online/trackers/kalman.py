"""Kalman filter with a random walk of π, through filterpy."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sms_online.state import State
from sms_online.stream import Array
from sms_online.trackers.factor import RANK_TOLERANCE, masked_covariance, solve, triangular_factor
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Estimate, Prior, Rows, Tracker, checked

if TYPE_CHECKING:
    from filterpy.kalman import KalmanFilter

# A parameter counts as determined once its variance is below this part of the initial one: the rows then carry as much
# information about it as the initial guess did.
INFORMED_VARIANCE = 0.5


class KalmanState(State):
    """What the filter knows.

    x (n, 1), P (n, n): deviation from the initial value and its covariance, in units of the initial std. nis: sum of
    squared normalised innovations. newest: time of the newest row, s.
    """

    x: Array
    P: Array
    rows: int = 0
    nis: float = 0.0
    newest: float | None = None


class KalmanTracker(Tracker):
    """Random walk of π, observed through Y π = b, one row at a time.

    process_std: (n,) how far each parameter wanders in one second, in its unit per √s. initial: value and std of every
    parameter (all stds must be given). State and covariance are kept in units of the initial std, so that parameters of
    very different size do not spoil the covariance. A variance never exceeds its initial one: without excitation the
    walk stops there instead of growing for ever. `determined` is judged by what the rows add to the initial std.
    Rows not newer than the newest so far add no process noise. rss is the sum of squared normalised innovations, about
    one a row. Source: filterpy.kalman.KalmanFilter, which updates the covariance in Joseph's form.
    """

    def __init__(self, n: int, process_std: Array, initial: Prior) -> None:
        if process_std.shape != (n,) or not (np.isfinite(process_std) & (process_std >= 0)).all():
            raise ValueError(f"process_std of shape {process_std.shape}; expected {n} finite numbers, none negative")
        if initial.std.size != n or not initial.known.all():
            raise ValueError(f"initial value and std of {np.count_nonzero(initial.known)} parameters; expected all {n}")
        self._n = n
        self._initial = initial
        self._walk = (process_std / initial.std) ** 2  # scaled variance per second
        self._filter = _scaled_filter(n)
        self.begin(Information.none(n))

    def update(self, rows: Rows) -> None:
        """Take in rows; ValueError where their width is not n (filterpy itself would take any)."""
        whitened = rows.whitened(self._n)
        b = whitened[:, self._n] - whitened[:, : self._n] @ self._initial.value
        Y = whitened[:, : self._n] * self._initial.std
        self._filter.x, self._filter.P = self.state.x, self.state.P
        for row in range(len(Y)):
            self._predict(float(rows.t[row]))
            # x is the deviation from the initial value in units of the initial std; the row's noise is one.
            self._filter.update(b[row : row + 1], R=1.0, H=Y[row : row + 1])
            self._filter.P = 0.5 * (self._filter.P + self._filter.P.T)
            self.state.nis += float(self._filter.y[0, 0] ** 2 / self._filter.S[0, 0])
        self.state.x, self.state.P = self._filter.x, self._filter.P
        self.state.rows += len(Y)

    def _predict(self, t: float) -> None:
        if self.state.newest is not None and t > self.state.newest:
            self._filter.predict(Q=np.diag(self._walk * (t - self.state.newest)))
            shrink = 1.0 / np.sqrt(np.maximum(np.diag(self._filter.P), 1.0))
            self._filter.P = self._filter.P * np.outer(shrink, shrink)
        self.state.newest = t if self.state.newest is None else max(t, self.state.newest)

    def estimate(self) -> Estimate:
        """The filtered π; leaves the state as it is."""
        P = self.state.P
        std = self._initial.std
        determined = np.diag(P) < INFORMED_VARIANCE
        return Estimate(
            pi=self._initial.value + std * self.state.x[:, 0],
            covariance=masked_covariance(P * np.outer(std, std), determined),
            covariance_robust=None,
            determined=determined,
            condition_number=_condition_number(P),
            rows=self.state.rows,
            rss=self.state.nis,
            dof=self.state.rows,
        )

    @property
    def information(self) -> Information:
        """What is known of π now, initial values included."""
        root = np.linalg.inv(np.linalg.cholesky(self.state.P)) / self._initial.std
        factor = np.zeros((self._n + 1, self._n + 1))
        factor[:-1, :-1] = root
        factor[:-1, -1] = root @ (self._initial.value + self._initial.std * self.state.x[:, 0])
        factor[-1, -1] = np.sqrt(self.state.nis)
        return Information(triangular_factor(factor), self.state.rows)

    def begin(self, known: Information) -> None:
        """Forget all rows; start from the initial value and std together with given information about π."""
        checked(known, self._n)
        # In units of the initial std about the initial value, as the filter's own state.
        Y, b = (
            known.factor[:, :-1] * self._initial.std,
            known.factor[:, -1] - known.factor[:, :-1] @ self._initial.value,
        )
        initial = np.eye(self._n, self._n + 1)
        solution = solve(np.concatenate((initial, np.column_stack((Y, b)))))
        self.state = KalmanState(solution.pi[:, None], solution.covariance(), known.rows, solution.rss)


def _scaled_filter(n: int) -> KalmanFilter:
    """filterpy's filter of n parameters that stay as they are."""
    from filterpy.kalman import KalmanFilter  # 0.75 s, for those who use it

    out = KalmanFilter(dim_x=n, dim_z=1)
    out.F = np.eye(n)
    return out


def _condition_number(P: Array) -> float:
    """Condition number of the column-scaled square root of P⁻¹; inf where P is singular to rounding."""
    std = np.sqrt(np.diag(P))
    eigenvalues, V = np.linalg.eigh(P / np.outer(std, std))
    if eigenvalues[0] <= RANK_TOLERANCE * eigenvalues[-1]:
        return np.inf
    information = (V / eigenvalues) @ V.T
    size = np.sqrt(np.diag(information))
    spectrum = np.linalg.eigvalsh(information / np.outer(size, size))
    return float(np.sqrt(spectrum[-1] / spectrum[0])) if spectrum[0] > 0 else np.inf
