"""The result of a session as one document, results.json: what was identified, how well, and what was left over."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_online.description.parse import describe
from sms_online.judgement import Discrepancy, Facts, Judgement, judge
from sms_online.physical import PhysicalSet, Projection
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.events import Event
from sms_online.row_types import ENERGY, joint_rows, row_types
from sms_online.stream import Array
from sms_online.threads import one_blas_thread
from sms_online.trackers.interface import Estimate

SCHEMA = "sms-online/results/1"
# Half width of a 95 % interval in standard deviations.
NORMAL_95 = 1.959963984540054
# An estimate within three standard deviations of zero is not determined by the data: not even its sign is certain.
LARGEST_RELATIVE_STD = 1.0 / 3.0
# Mean square of rows over their predicted variance that noise alone may leave: that of the noise is estimated to 7 %.
LARGEST_ROW_VARIANCE = 1.2
# Rows of the energy balance, for each parameter, from which on its first transient is forgotten.
ROWS_A_PARAMETER = 10
# Noise in the columns matters where it pulls an estimate by more than this many standard deviations.
LARGEST_PULL = 1.0
# Quantities that cannot be negative, as the ends of names.
POSITIVE = ("mass", "mass_per_length", "stiffness", "damping", "rotor_inertia", "rigidity", "rigidity_y", "rigidity_z")


@one_blas_thread()
def standard_deviation(estimator: Estimator, estimate: Estimate | None = None) -> Array:
    """1σ of each parameter (n,) as known now, inf where the data determine nothing.

    estimate: the estimator's own of now, where it is at hand: to make it costs milliseconds.
    The smoother's covariance follows from the noise of sensors and torques, and of forces where it had to allow some.
    Rows of the momentum balance have a predicted variance. While the residual agrees with it, the estimate's covariance
    follows from it; where rows leave more, the model lacks something and the residual decides, as it does for rows of
    the energy balance.
    From the residual: the larger of two answers. One takes the rows' errors as independent with the residual's
    variance, the other allows errors that last within clusters of rows. To it comes what errors add that rows of an
    energy window share, which least squares absorbs and no residual shows; it is known while no row is forgotten. Where
    rows have been weighed against a prior, the posterior's own covariance holds.
    """
    if estimate is None:
        estimate = estimator.estimate()
    std = np.full(estimate.pi.shape, np.inf)
    if estimate.dof <= 0.0:
        return std
    known = estimate.determined
    if estimate.scale is not None or estimator.by_smoother:
        std[known] = estimate.std[known]
        return std
    row_variance = estimate.rss / estimate.dof
    if estimator.by_momentum and row_variance <= LARGEST_ROW_VARIANCE and not estimator.misfit:
        std[known] = estimate.std[known]
        return std
    variance = np.diag(estimate.covariance)[known] * row_variance
    if estimate.covariance_robust is not None:
        variance = np.maximum(variance, np.diag(estimate.covariance_robust)[known])
    if not estimator.by_momentum and estimate.rows == estimator.shared_errors.rows:
        inverse = np.where(np.outer(known, known), estimate.covariance, 0.0)
        variance = variance + estimator.shared_errors.variance(inverse, row_variance)[known]
    std[known] = np.sqrt(variance)
    return std


def identifiable(beta: Array, std: Array) -> NDArray[np.bool_]:
    """Which parameters β (n,) the data determine: std (n,) is finite, and β three of it from zero."""
    return np.asarray(std <= LARGEST_RELATIVE_STD * np.abs(beta))


def residuals(estimator: Estimator, beta: Array) -> dict[str, dict[str, float | None]]:
    """By row type: `relative` to the measured torque or force, `whitened` over its predicted standard deviation."""
    layout, momentum = estimator.model.layout, estimator.momentum

    relative = {joint_rows(i): joint.relative(beta) for i, joint in enumerate(estimator.joint_residuals)}
    out: dict[str, dict[str, float | None]] = {ENERGY: {"relative": None, "whitened": None}}
    for name, speeds in row_types(layout).items():
        # Where the smoother knows better, rows of the balance see shapes that are not the links'.
        whitened = None if momentum is None or estimator.by_smoother else momentum.whitened(speeds, beta)
        out[name] = {"relative": relative.get(name), "whitened": whitened}
    return out


def pulled(estimator: Estimator, estimate: Estimate, std: Array) -> list[str]:
    """Names of parameters that noise in the columns pulls by more than their std (n,): errors in variables.

    The comparison is Hausman's, of least squares with an estimate that is free of this bias.
    """
    if estimator.momentum is None or not estimator.by_momentum:
        return []
    shift = np.abs(estimator.momentum.bias.correction(estimate.determined)[0])
    return [p.name for p, s, d in zip(estimator.base.parameters, shift, std, strict=True) if s > LARGEST_PULL * d]


@one_blas_thread()
def judged(
    estimator: Estimator,
    estimate: Estimate | None = None,
    discrepancies: Sequence[Discrepancy] = (),
    troubles: Sequence[str] = (),
    projection: Projection | None = None,
) -> Judgement:
    """May the estimate be trusted? As known now; the answer changes while a session runs.

    estimate: the estimator's own of now, where it is at hand. discrepancies: of the diagnosis that runs beside it, if
    one does. troubles: see `Facts`. projection: onto real bodies, where it has been made.
    """
    if estimate is None:
        estimate = estimator.estimate()
    std = standard_deviation(estimator, estimate)
    flags = identifiable(estimate.pi, std)
    names = [p.name for p in estimator.base.parameters]
    momentum = estimator.momentum
    lost = estimator.counters.lost_samples
    below = flags & (estimate.pi + NORMAL_95 * np.where(flags, std, 0.0) < 0.0)
    alarm = unweighed = None
    if momentum is not None:
        alarm = None if momentum.test.alarm is None else momentum.test.alarm.row
        unweighed = None if momentum.fit.unexplained is None else joint_rows(momentum.fit.unexplained)
    return judge(
        Facts(
            determined=(int(np.count_nonzero(flags)), flags.size),
            undetermined=tuple(name for name, known in zip(names, flags, strict=True) if not known),
            settling=_settling(estimator, estimate, bool(flags.any())),
            residual=residuals(estimator, estimate.pi),
            negative=tuple(
                name for name, negative in zip(names, below, strict=True) if negative and name.endswith(POSITIVE)
            ),
            pulled=tuple(pulled(estimator, estimate, std)),
            alarm=alarm,
            unweighed=unweighed,
            undecided=tuple(event.time for event in estimator.events if event.kind == "undecided"),
            distance=0.0 if projection is None else projection.distance,
            lost=lost / max(1, lost + estimator.samples),
            discrepancies=tuple(discrepancies),
            troubles=(*troubles, *_weaknesses(estimator)),
        )
    )


def _settling(estimator: Estimator, estimate: Estimate, known: bool) -> str:
    """Why the estimate will still move by more than its error bars."""
    if not known:
        return "no parameter is determined, for want of motion"
    smoother, momentum = estimator.smoother, estimator.momentum
    if smoother is not None and smoother.spans == 0 and not smoother.failures:
        return "the smoother has not worked off its first span"
    if estimator.by_smoother:
        return ""
    if momentum is None:
        few = estimate.dof < ROWS_A_PARAMETER * estimate.pi.size
        return "the energy balance has few rows yet" if few else ""
    if not momentum.started:
        return "the first fit has no weights yet, for want of motion"
    if momentum.settled or (estimator.events and estimator.events[-1].kind == "undecided"):
        return ""
    after = f" since the change at {estimator.events[-1].time:.1f} s" if estimator.events else ""
    return f"the test for more than noise has seen too few rows{after}"


def _weaknesses(estimator: Estimator) -> list[str]:
    """What weakens an estimate by the way it is made."""
    out = []
    smoother, momentum = estimator.smoother, estimator.momentum
    if smoother is not None and smoother.level > 0.0 and estimator.by_smoother:
        out.append("samples do not agree with the equations of motion")
    if momentum is None and not estimator.by_smoother:
        out.append("by the energy balance alone, nothing tests whether the model lacks something")
    if smoother is not None and not estimator.by_smoother and estimator.sensing.missing:
        out.append("links are taken as bent statically: estimates are off by percents")
    late = None if momentum is None else momentum.latencies.found
    if late is not None:
        whose = late.source if late.size > 0.0 else f"all sources but {late.source}"
        out.append(f"{whose}: {1e3 * abs(late.size):.2g} ms later than stated")
    return out


def method(estimator: Estimator) -> str:
    """What the estimate comes from: `smoother`, or the `momentum` or `energy` balance."""
    if estimator.by_smoother:
        return "smoother"
    return "momentum" if estimator.by_momentum else "energy"


def _smoother_warnings(estimator: Estimator) -> list[str]:
    """What the smoother replaced, and where it failed."""
    smoother = estimator.smoother
    if smoother is None:
        asked = estimator.system.balance == "smoother"
        return ["no smoother: it does not know of the effects on channels that are declared"] if asked else []
    out = [f"the smoother left out {failure}" for failure in smoother.failures]
    missing = ", ".join(estimator.sensing.missing)
    if estimator.by_smoother:
        if missing:
            out.append(f"not measured, and told by the equations of motion: {missing}")
        if smoother.level > 0.0:
            share = f"{100.0 * smoother.level:.2g} % of the usual ones"
            out.append(f"samples do not agree with the equations of motion: unknown forces of {share} are allowed for")
    elif missing:
        out.append(f"links are taken as bent statically, for {missing} are not measured: estimates are off by percents")
    return out


def projected(estimator: Estimator, estimate: Estimate, std: Array) -> Projection | None:
    """The parameters of real bodies that are nearest to the estimate, by its covariance with deviations std (n,).

    None where they are not found: a finished session is not lost for it.
    """
    known = np.flatnonzero(np.isfinite(std))
    stated = estimate.std[known]
    scale = np.divide(std[known], stated, out=np.ones_like(stated), where=stated > 0.0)
    covariance = np.diag(np.full(std.size, np.inf))
    covariance[np.ix_(known, known)] = estimate.covariance[np.ix_(known, known)] * np.outer(scale, scale)
    try:
        return PhysicalSet(estimator.model, estimator.base).project(estimate.pi, covariance)
    except ArithmeticError:
        return None


def _projection_warning(projection: Projection | None) -> list[str]:
    if projection is None:
        return ["whether real bodies can have these parameters is not known: the search for them did not converge"]
    if projection.distance == 0.0:
        return []
    distance, names = f"{projection.distance:.2g} standard deviations", ", ".join(projection.active)
    return [f"no real bodies have these parameters, because of {names}: the nearest that some have are {distance} away"]


def event_document(event: Event) -> dict[str, Any]:
    """An event as results.json holds it."""
    jumps = zip(event.parameters, event.units, event.sizes, event.stds, strict=True)
    return {
        "time": event.time,
        "kind": event.kind,
        "parameters": [{"name": name, "unit": unit, "size": size, "std": std} for name, unit, size, std in jumps],
        "dropped_windows": event.dropped_windows,
    }


@one_blas_thread()
def results_document(
    estimator: Estimator,
    throughput: float,
    warnings: list[str],
    truth: dict[str, float] | None = None,
    bound: Array | None = None,
    discrepancies: Sequence[Discrepancy] = (),
) -> dict[str, Any]:
    """results.json of a finished session.

    throughput: samples/s. truth: true values of physical parameters by name, of a simulated capture; they enter this
    report alone. bound (n,): Cramér-Rao bound of each base parameter, where it has been computed. discrepancies: of the
    diagnosis that ran beside it. Numbers that do not exist (the std of an undetermined parameter) are None. After an
    event parameters and residuals are those since then.
    """
    estimate = estimator.estimate()
    base = estimator.base
    true = None
    if truth is not None and all(p.name in truth for p in base.physical):
        true = base.values(np.array([truth[p.name] for p in base.physical]))
    deviations = standard_deviation(estimator, estimate)
    flags = identifiable(estimate.pi, deviations)
    projection = projected(estimator, estimate, deviations)
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
                "projected": float(projection.beta[k]) if projection is not None and projection.active else None,
                "bound": None if bound is None or k >= bound.size or not np.isfinite(bound[k]) else float(bound[k]),
            }
        )
    judgement = judged(estimator, estimate, discrepancies, projection=projection)
    return {
        "schema": SCHEMA,
        "system": describe(estimator.system),
        "samples": estimator.samples,
        "duration_s": estimator.duration,
        "method": method(estimator),
        "verdict": judgement.document(),
        "parameters": parameters,
        "events": [event_document(event) for event in estimator.events],
        "residual": residuals(estimator, estimate.pi),
        "physical": None
        if projection is None
        else {"distance_std": projection.distance, "active": list(projection.active)},
        "condition_number": estimate.condition_number if np.isfinite(estimate.condition_number) else None,
        "throughput_samples_per_s": throughput,
        "lost_samples": estimator.counters.lost_samples,
        "warnings": [
            *warnings,
            *(reason.full for reason in judgement.reasons if reason.full),
            *_projection_warning(projection),
            *_smoother_warnings(estimator),
        ],
    }
