"""The result of a session as one document, results.json: what was identified, how well, and what was left over."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_online.description.parse import describe
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array

SCHEMA = "sms-online/results/1"
# Half width of a 95 % interval in standard deviations.
NORMAL_95 = 1.959963984540054
# An estimate within three standard deviations of zero is not determined by the data: not even its sign is certain.
LARGEST_RELATIVE_STD = 1.0 / 3.0


def standard_deviation(estimator: Estimator) -> Array:
    """1σ of each parameter (n,) as known now, inf where the data determine nothing.

    The larger of two answers from the residual: one takes the rows' errors as independent with the residual's variance,
    the other allows errors that last within clusters of rows, as those of an integrated balance do. To it comes what
    the error of each window's first instant adds, which no residual shows.
    """
    estimate = estimator.estimate()
    std = np.full(estimate.pi.shape, np.inf)
    if estimate.dof <= 0.0:
        return std
    known = estimate.determined
    row_variance = estimate.rss / estimate.dof
    variance = np.diag(estimate.covariance)[known] * row_variance
    if estimate.covariance_robust is not None:
        variance = np.maximum(variance, np.diag(estimate.covariance_robust)[known])
    inverse = np.where(np.outer(known, known), estimate.covariance, 0.0)
    shared = row_variance * estimate.scale**2 * estimator.starts.variance(inverse / estimate.scale**2)
    std[known] = np.sqrt(variance + shared[known])
    return std


def identifiable(estimator: Estimator) -> NDArray[np.bool_]:
    """Which parameters (n,) the data determine: in the span of the rows, and three standard deviations from zero."""
    estimate = estimator.estimate()
    return estimate.determined & (standard_deviation(estimator) <= LARGEST_RELATIVE_STD * np.abs(estimate.pi))


def results_document(
    estimator: Estimator, throughput: float, warnings: list[str], truth: dict[str, float] | None = None
) -> dict[str, Any]:
    """results.json of a finished session.

    throughput: samples/s. truth: true values of physical parameters by name, of a simulated capture; they enter this
    report alone. Numbers that do not exist (the std of an undetermined parameter) are None.
    """
    estimate = estimator.estimate()
    base = estimator.base
    true = None
    if truth is not None and all(p.name in truth for p in base.physical):
        true = base.values(np.array([truth[p.name] for p in base.physical]))
    flags, deviations = identifiable(estimator), standard_deviation(estimator)
    parameters = []
    for k, p in enumerate(base.parameters):
        value, std = float(estimate.pi[k]), float(deviations[k])
        finite = bool(np.isfinite(std))
        parameters.append(
            {
                "name": p.name,
                "symbol": p.symbol,
                "unit": p.unit,
                "estimate": value,
                "std": std if finite else None,
                "lower95": value - NORMAL_95 * std if finite else None,
                "upper95": value + NORMAL_95 * std if finite else None,
                "true": None if true is None else float(true[k]),
                "identifiable": bool(flags[k]),
            }
        )
    residual: dict[str, dict[str, float | None]] = {"energy": {"relative": None, "whitened": None}}
    for i, joint in enumerate(estimator.joint_residuals, start=1):
        residual[f"joint_{i}"] = {"relative": joint.relative(estimate.pi), "whitened": None}
    return {
        "schema": SCHEMA,
        "system": describe(estimator.system),
        "samples": estimator.samples,
        "duration_s": estimator.duration,
        "parameters": parameters,
        "residual": residual,
        "condition_number": estimate.condition_number if np.isfinite(estimate.condition_number) else None,
        "throughput_samples_per_s": throughput,
        "lost_samples": estimator.counters.lost_samples,
        "warnings": warnings,
    }
