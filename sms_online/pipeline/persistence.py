"""Whether what rows leave lasts from window to window: a force that the model lacks does, a sensor's noise does not.

Source: Box and Pierce, Journal of the American Statistical Association 65 (1970) 1509 (the sum of squared
autocorrelations).
"""

from __future__ import annotations

from math import ceil

import msgspec
import numpy as np

from sms_online.pipeline.momentum_windows import OVERLAP
from sms_online.state import Stage, State
from sms_online.stream import Array, Mask

# Windows from one to another that are compared: from the nearest whose noise is independent, for samples at the ends of
# a window count little, to three times as far.
LAGS = range(ceil(OVERLAP), ceil(3.0 * OVERLAP) + 1)
# Windows that are kept, the last ones; fewer than the least say nothing.
KEPT, LEAST_WINDOWS = 600, 200
# Variance of a mean product of white noise in overlapping windows, times their number: 1 + 2 Σ ρ² of those overlaps.
OVERLAPPING = 3.4
# The sum of squares over what noise leaves of it in the mean, at most; that scatters by a half.
MOST = 2.5


class PersistenceState(State):
    """What is kept: some rows [N Y b] (k, m + n + 1) of each of the last windows."""

    rows: list[Array] = msgspec.field(default_factory=list)


class Persistence(Stage):
    """Keeps the last rows of some generalized speeds, for what they leave to be seen once the estimate is known."""

    def __init__(self) -> None:
        self.state = PersistenceState()

    def push(self, rows: Array) -> None:
        """Rows [N Y b] (k, m + n + 1) of the next window."""
        self.state.rows.append(rows)
        if len(self.state.rows) > KEPT:
            self.state.rows.pop(0)

    @property
    def decides(self) -> bool:
        """Whether there are windows enough to show whether what they leave lasts."""
        return len(self.state.rows) >= LEAST_WINDOWS

    def passing(self, beta: Array) -> Mask:
        """Of which rows (k,) what is left by nuisances and parameters β (m + n,) is shown not to last."""
        if not self.decides:
            return np.zeros(len(self.state.rows[0]) if self.state.rows else 0, dtype=np.bool_)
        left = np.array(self.state.rows) @ np.append(beta, -1.0)
        left = left / np.sqrt(np.mean(left**2, axis=0))
        correlations = np.array([np.mean(left[lag:] * left[:-lag], axis=0) for lag in LAGS])
        squares = len(left) / OVERLAPPING * np.sum(correlations**2, axis=0)
        return np.asarray(squares < MOST * len(LAGS))
