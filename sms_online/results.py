"""The result of a session as one document, results.json: what was identified, how well, and what was left over."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_online.description.parse import describe
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array
from sms_online.trackers.interface import Estimate

SCHEMA = "sms-online/results/1"
# Half width of a 95 % interval in standard deviations.
NORMAL_95 = 1.959963984540054
# An estimate within three standard deviations of zero is not determined by the data: not even its sign is certain.
LARGEST_RELATIVE_STD = 1.0 / 3.0


def standard_deviation(estimate: Estimate) -> Array:
    """1σ of each parameter (n,): the larger of two answers from the residual, inf where the data determine nothing.

    One takes the rows' errors as independent with the residual's variance, the other allows errors that last within
    clusters of rows, as those of an integrated balance do.
    """
    if estimate.dof <= 0.0:
        return np.full(estimate.pi.shape, np.inf)
    std = np.full(estimate.pi.shape, np.inf)
    known = estimate.determined
    std[known] = estimate.std[known] * np.sqrt(estimate.rss / estimate.dof)
    return std if estimate.std_robust is None else np.maximum(std, estimate.std_robust)


def identifiable(estimate: Estimate) -> NDArray[np.bool_]:
    """Which parameters (n,) the data determine: in the span of the rows, and three standard deviations from zero."""
    return estimate.determined & (standard_deviation(estimate) <= LARGEST_RELATIVE_STD * np.abs(estimate.pi))


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
    flags, deviations = identifiable(estimate), standard_deviation(estimate)
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
