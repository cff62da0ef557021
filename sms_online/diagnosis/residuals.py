"""Residuals of a session's rows by row type, compared with what noise alone would leave."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from sms_online.diagnosis.rows import SessionRows
from sms_online.row_types import row_types
from sms_online.stream import Array

# Sensors' noise, and with it the predicted variance of rows, is known to a tenth where it is estimated from samples.
NOISE_KNOWN = 0.1
# Probability that noise alone takes any row type beyond its limit.
FALSE_ALARM = 0.01


@dataclass(frozen=True)
class RowResidual:
    """Residual of one row type.

    whitened: rms over the predicted deviation. limit: what noise alone exceeds in one of 1 / FALSE_ALARM sessions.
    """

    whitened: float
    limit: float

    @property
    def beyond(self) -> bool:
        """Whether it is more than noise."""
        return self.whitened > self.limit


class ResidualTest:
    """Tests residuals (W, n_v), each row over its own predicted deviation, against noise alone.

    types: speeds by name; those of the row types unless given.
    Mean squares of rows that share noise have fewer degrees of freedom than there are rows (Satterthwaite, Biometrics
    Bulletin 2 (1946) 110).
    """

    def __init__(self, rows: SessionRows, types: Mapping[str, list[int]] | None = None) -> None:
        self.types = row_types(rows.model.layout) if types is None else types
        freedom = {name: rows.freedom(speeds) for name, speeds in self.types.items()}
        level = FALSE_ALARM / len(self.types)
        self.limit = {
            name: float(np.sqrt(chi2.isf(level, nu) / nu)) * (1.0 + NOISE_KNOWN) for name, nu in freedom.items()
        }

    def of(self, residual: Array) -> dict[str, RowResidual]:
        """By row type."""
        return {name: RowResidual(rms(residual[:, speeds]), self.limit[name]) for name, speeds in self.types.items()}


def whitened(rows: SessionRows, residual: Array) -> dict[str, float]:
    """rms of residuals (W, n_v) by row type."""
    return {name: rms(residual[:, speeds]) for name, speeds in row_types(rows.model.layout).items()}


def rms(values: Array | Sequence[float]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
