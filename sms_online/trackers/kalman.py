"""Kalman filter with a random walk of π, through filterpy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from sms_online.stream import Array
from sms_online.trackers.factor import RANK_TOLERANCE, masked_covariance, solve
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Estimate, Prior, Rows, State, checked, saved_array, saved_number

if TYPE_CHECKING:
    from filterpy.kalman import KalmanFilter

# A parameter counts as determined once its variance is below this part of the initial one: the rows then carry as much
# information about it as the initial guess did.
INFORMED_VARIANCE = 0.5


class KalmanTracker:
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
        self.enabled = True
        self._n = n
        self._initial = initial
        self._walk = (process_std / initial.std) ** 2  # scaled variance per second
        self._start()

    def _start(self) -> None:
        self._filter = _scaled_filter(self._n)
        self._rows = 0
        self._nis = 0.0
        self._newest: float | None = None

    def update(self, rows: Rows) -> None:
        """Take in rows; ValueError where their width is not n (filterpy itself would take any)."""
        if not self.enabled:
            return
        whitened = rows.whitened(self._n)
        b = whitened[:, self._n] - whitened[:, : self._n] @ self._initial.value
        Y = whitened[:, : self._n] * self._initial.std
        for row in range(len(Y)):
            self._predict(float(rows.t[row]))
            # x is the deviation from the initial value in units of the initial std; the row's noise is one.
            self._filter.update(b[row : row + 1], R=1.0, H=Y[row : row + 1])
            self._filter.P = 0.5 * (self._filter.P + self._filter.P.T)
            self._nis += float(self._filter.y[0, 0] ** 2 / self._filter.S[0, 0])
        self._rows += len(Y)

    def _predict(self, t: float) -> None:
        if self._newest is not None and t > self._newest:
            self._filter.predict(Q=np.diag(self._walk * (t - self._newest)))
            shrink = 1.0 / np.sqrt(np.maximum(np.diag(self._filter.P), 1.0))
            self._filter.P *= np.outer(shrink, shrink)
        self._newest = t if self._newest is None else max(t, self._newest)

    def estimate(self) -> Estimate:
        """The filtered π; leaves the state as it is."""
        P = self._filter.P
        std = self._initial.std
        determined = np.diag(P) < INFORMED_VARIANCE
        return Estimate(
            pi=self._initial.value + std * self._filter.x[:, 0],
            covariance=masked_covariance(P * np.outer(std, std), determined),
            covariance_robust=None,
            determined=determined,
            condition_number=_condition_number(P),
            rows=self._rows,
            rss=self._nis,
            dof=self._rows,
        )

    def reset(self) -> None:
        """Forget all rows; start again from the initial value and std."""
        self._start()

    def begin(self, known: Information) -> None:
        """Forget all rows; start from the initial value and std together with what others say of π."""
        checked(known, self._n)
        self._start()
        # In units of the initial std about the initial value, as the filter's own state.
        Y, b = (
            known.factor[:, :-1] * self._initial.std,
            known.factor[:, -1] - known.factor[:, :-1] @ self._initial.value,
        )
        initial = np.eye(self._n, self._n + 1)
        solution = solve(np.concatenate((initial, np.column_stack((Y, b)))))
        self._filter.x, self._filter.P = solution.pi[:, None], solution.covariance()
        self._rows, self._nis = known.rows, solution.rss

    def state(self) -> State:
        """Everything needed to continue bit for bit."""
        state: State = {
            "enabled": float(self.enabled),
            "x": self._filter.x[:, 0].copy(),
            "P": self._filter.P.copy(),
            "rows": float(self._rows),
            "nis": self._nis,
        }
        if self._newest is not None:
            state["newest"] = self._newest
        return state

    def restore(self, state: Mapping[str, Array | float]) -> None:
        """Continue from a state saved by a tracker built with the same arguments; ValueError where it does not fit."""
        x = saved_array(state, "x", (self._n,))
        P = saved_array(state, "P", (self._n, self._n))
        rows, nis, enabled = (saved_number(state, key) for key in ("rows", "nis", "enabled"))
        self._filter.x, self._filter.P = x[:, None], P
        self._rows, self._nis, self.enabled = int(rows), nis, bool(enabled)
        self._newest = saved_number(state, "newest") if "newest" in state else None


def _scaled_filter(n: int) -> KalmanFilter:
    """filterpy's filter at x = 0, P = I: zero deviation from the initial value, in units of the initial std."""
    from filterpy.kalman import KalmanFilter  # 0.75 s, for those who use it

    out = KalmanFilter(dim_x=n, dim_z=1)
    out.x = np.zeros((n, 1))
    out.P = np.eye(n)
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
