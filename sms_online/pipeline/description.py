"""Described values as a loose prior of the values behind the weights.

Weights need a value of every parameter, also of those that the motion does not determine. An estimate of these may be
anything, and noise that is propagated with it hides everything else. Only weights know of this prior.
"""

from __future__ import annotations

import numpy as np

from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.stream import Array
from sms_online.trackers.interface import Estimate

# Standard deviation of a described value, in units of its size.
LOOSE = 1.0


def described(model: Model, base: BaseParameters) -> tuple[Array, Array]:
    """Nominal β (n,), and their sizes (n,), those of the physical parameters in them without their signs."""
    pi = model.nominal
    size = np.hypot(pi[list(base.independent)], np.linalg.norm(base.mixture * pi[list(base.dependent)], axis=1))
    return base.values(pi), size


def near_rows(value: Array, size: Array, nuisances: int) -> Array:
    """Described values (n,) as normal priors: rows [N Y b] (k, m + n + 1) of unit variance; see `nearer`."""
    known = np.flatnonzero(size > 0.0)
    rows = np.zeros((known.size, nuisances + value.size + 1))
    unit = LOOSE * size[known]
    rows[np.arange(known.size), nuisances + known] = 1.0 / unit
    rows[:, -1] = value[known] / unit
    return rows


def nearer(estimate: Estimate, value: Array, size: Array) -> Array:
    """Nuisances and π (m + n,) of an estimate, with described values (n,) as normal priors of π.

    size (n,): LOOSE · size is the standard deviation of each; zero is no prior.
    """
    m = estimate.nuisances.size
    out = np.concatenate((estimate.nuisances, np.where(estimate.determined, estimate.pi, value)))
    known = np.flatnonzero(estimate.determined & (size > 0.0))
    if not known.size:
        return out
    unit = LOOSE * size[known]
    covariance = estimate.covariance[:, known] / unit
    information = np.linalg.inv(covariance[known] / unit[:, None] + np.eye(known.size))
    every = covariance if estimate.crossed is None else np.concatenate((estimate.crossed[:, known] / unit, covariance))
    out += every @ (information @ ((value - estimate.pi)[known] / unit))
    out[m:] = np.where(estimate.determined, out[m:], value)
    return out
