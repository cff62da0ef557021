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
# A joint whose unexplained torque reaches this share of the measured one lacks an effect, whatever the error bars say.
LARGEST_RESIDUAL = 0.5
# Quantities that cannot be negative, as the ends of names.
POSITIVE = ("mass", "mass_per_length", "stiffness", "damping", "rotor_inertia", "rigidity", "rigidity_y", "rigidity_z")


def standard_deviation(estimator: Estimator) -> Array:
    """1σ of each parameter (n,) as known now, inf where the data determine nothing.

    The larger of two answers from the residual: one takes the rows' errors as independent with the residual's
    variance, the other allows errors that last within clusters of rows. To it comes what errors add that rows of a
    window share, which least squares absorbs and no residual shows; it is known while no row is forgotten. Where rows
    have been weighed against a prior, the posterior's own covariance holds.
    """
    return _standard_deviation(estimator, estimator.estimate())


def _standard_deviation(estimator: Estimator, estimate: Estimate) -> Array:
    std = np.full(estimate.pi.shape, np.inf)
    if estimate.dof <= 0.0:
        return std
    known = estimate.determined
    if estimate.scale is not None:
        std[known] = estimate.std[known]
        return std
    row_variance = estimate.rss / estimate.dof
    variance = np.diag(estimate.covariance)[known] * row_variance
    if estimate.covariance_robust is not None:
        variance = np.maximum(variance, np.diag(estimate.covariance_robust)[known])
    if estimate.rows == estimator.shared_errors.rows:
        inverse = np.where(np.outer(known, known), estimate.covariance, 0.0)
        variance = variance + estimator.shared_errors.variance(inverse, row_variance)[known]
    std[known] = np.sqrt(variance)
    return std


def identifiable(estimator: Estimator) -> NDArray[np.bool_]:
    """Which parameters (n,) the data determine: in the span of the rows, and three standard deviations from zero."""
    estimate = estimator.estimate()
    return _identifiable(estimate, _standard_deviation(estimator, estimate))


def _identifiable(estimate: Estimate, std: Array) -> NDArray[np.bool_]:
    return estimate.determined & (std <= LARGEST_RELATIVE_STD * np.abs(estimate.pi))


def doubts(parameters: list[dict[str, Any]], residual: dict[str, dict[str, float | None]]) -> list[str]:
    """Reasons not to trust a fit that its error bars do not know of, a sentence each."""
    out = []
    for name, rows in residual.items():
        relative = rows["relative"]
        if relative is not None and relative > LARGEST_RESIDUAL:
            share = f"{100.0 * relative:.0f} % of the torque or force of {name} is not explained"
            out.append(f"{share}: the model lacks an effect there, and the parameters bend to replace it")
    for p in parameters:
        if p["identifiable"] and p["upper95"] < 0.0 and p["name"].endswith(POSITIVE):
            out.append(
                f"{p['name']} is negative, which is not physical: the model lacks an effect, or the data are weak"
            )
    return out


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
    deviations = _standard_deviation(estimator, estimate)
    flags = _identifiable(estimate, deviations)
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
        "warnings": [*warnings, *doubts(parameters, residual)],
    }
