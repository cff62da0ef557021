"""Estimates of each tracker of a session, and whether its rows agree with its error bars."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sms_online.trackers.interface import Estimate

# Noise behind the rows' predicted variance is estimated to so much of that variance, 1σ.
NOISE_VARIANCE_STD = 0.07
# Half width of a band that holds 99.9 % of a normal variable: beyond it the estimate is not trusted.
BAND = 3.29


@dataclass(frozen=True)
class Consistency:
    """Normalised innovations squared of a tracker's rows: their mean over its memory, 1 where its model holds.

    nis: None while there are too few rows. lower, upper: band that holds 99.9 % of consistent sessions, from the number
    of rows and from how well the sensors' noise is known.
    """

    nis: float | None
    lower: float
    upper: float

    @property
    def consistent(self) -> bool | None:
        """Whether it is within its band; None while nothing is known."""
        return None if self.nis is None else self.lower <= self.nis <= self.upper

    @staticmethod
    def of(estimate: Estimate) -> Consistency:
        """Consistency of the rows behind an estimate."""
        if estimate.dof <= 0.0:
            return Consistency(None, 0.0, np.inf)
        width = BAND * float(np.hypot(np.sqrt(2.0 / estimate.dof), NOISE_VARIANCE_STD))
        return Consistency(float(estimate.rss / estimate.dof), max(0.0, 1.0 - width), 1.0 + width)


@dataclass(frozen=True)
class Tracked:
    """A parameter as one tracker has it: value, standard deviation, inf where undetermined, and whether determined."""

    value: float
    std: float
    determined: bool


@dataclass(frozen=True)
class Drift:
    """A parameter that a tracker has found to drift: since when, s, and its value and rate now.

    changed: since when at this rate, s, where it was another one before. unit: of the parameter and its value ±
    value_std; the rate ± std is in it per s.
    """

    parameter: str
    unit: str
    since: float
    changed: float | None
    rate: float
    std: float
    value: float
    value_std: float

    def document(self) -> dict[str, Any]:
        """As results.json holds it."""
        return {
            "parameter": self.parameter,
            "since": self.since,
            "changed": self.changed,
            "rate": self.rate,
            "rate_std": self.std,
            "value": self.value,
            "value_std": self.value_std if np.isfinite(self.value_std) else None,
            "unit": self.unit,
        }


@dataclass(frozen=True)
class TrackerResult:
    """One tracker of a session.

    name: for people. judged: its estimate is the session's. parameters: by name. consistency: see there. memory: rows
    that the estimate rests on, s. drifts: that it has found.
    """

    name: str
    judged: bool
    parameters: Mapping[str, Tracked]
    consistency: Consistency
    memory: float
    drifts: tuple[Drift, ...] = ()

    def document(self) -> dict[str, Any]:
        """As results.json holds it."""
        consistency = self.consistency
        return {
            "name": self.name,
            "judged": self.judged,
            "parameters": [
                {
                    "name": name,
                    "estimate": p.value,
                    "std": p.std if np.isfinite(p.std) else None,
                    "identifiable": p.determined,
                }
                for name, p in self.parameters.items()
            ],
            "nis": consistency.nis,
            "nis_lower": consistency.lower,
            "nis_upper": None if np.isinf(consistency.upper) else consistency.upper,
            "consistent": consistency.consistent,
            "memory_s": self.memory,
            "drifts": [drift.document() for drift in self.drifts],
        }
