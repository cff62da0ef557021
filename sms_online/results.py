"""The result of a session as one document, results.json: what was identified, how well, and what was left over."""

from __future__ import annotations

from typing import Any

import numpy as np

from sms_online.description.parse import describe
from sms_online.pipeline.estimator import Estimator
from sms_online.trackers.interface import Estimate

SCHEMA = "sms-online/results/1"
# Half width of a 95 % interval in standard deviations.
NORMAL_95 = 1.959963984540054
# A parameter whose standard deviation reaches this share of its estimate is not determined by the data.
LARGEST_RELATIVE_STD = 0.5


def identifiable(estimate: Estimate) -> Any:
    """Which parameters (n,) the data determine: in the span of the rows, and with an error below half the estimate."""
    with np.errstate(invalid="ignore"):
        small = estimate.std <= LARGEST_RELATIVE_STD * np.abs(estimate.pi)
    return estimate.determined & small


def results_document(
    estimator: Estimator, throughput: float, warnings: list[str], truth: dict[str, float] | None = None
) -> dict[str, Any]:
    """results.json of a finished session.

    throughput: samples/s. truth: true values of physical parameters by name, of a simulated capture; they enter this report
    alone. Numbers that do not exist (the std of an undetermined parameter) are None.
    """
    estimate = estimator.estimate()
    base = estimator.base
    true = None
    if truth is not None:
        true = base.values(np.array([truth[p.name] for p in base.physical]))
    flags = identifiable(estimate)
    parameters = []
    for k, p in enumerate(base.parameters):
        value, std = float(estimate.pi[k]), float(estimate.std[k])
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
        "condition_number": estimate.condition_number,
        "throughput_samples_per_s": throughput,
        "lost_samples": estimator.counters.lost_samples,
        "warnings": warnings,
    }
