"""Parameters of the model and coefficients of effects, as the rows of a diagnosis determine them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.diagnosis.attempt import Attempt
from sms_online.diagnosis.candidate import Finding
from sms_online.diagnosis.reported import Coefficients, of_constant, of_unknowns
from sms_online.diagnosis.search import Search
from sms_online.diagnosis.shape import slopes
from sms_online.evaluation import identifiable
from sms_online.model.parameters import Parameter as ModelParameter
from sms_online.result import Parameter, true_parameters
from sms_online.stream import Array
from sms_online.tables import finite


def coefficients(diagnosis: Search, finding: Finding) -> Coefficients:
    """What a person reads of an effect."""
    effect, attempt = finding.candidate.effect, diagnosis.attempt
    for k, (constant, candidate) in enumerate(zip(attempt.constants, attempt.fixed, strict=True)):
        if constant.key == effect.key:
            at = attempt.rows.base.n + sum(len(other.parameters) for other in attempt.fixed[:k])
            own = slice(at, at + len(candidate.parameters))
            covariance = attempt.tracing.covariance(diagnosis.chosen)[own, own]
            return of_constant(constant, covariance)
    batch, model = _batch(attempt, diagnosis.chosen), diagnosis.model
    names = [p.name for p in batch.parameters]
    reported = of_unknowns(effect, finding.candidate.parameters, model, names, batch.values, batch.covariance)
    shapes = {name: std for (key, name), std in batch.shapes.items() if key == finding.candidate.key}
    return {name: (value, shapes.get(name, std)) for name, (value, std) in reported.items()}


def posterior(attempt: Attempt, chosen: Sequence[int], truth: Mapping[str, float] | None = None) -> list[Parameter]:
    """Parameters from the rows of the diagnosis: these tolerate a prior where the model lacks much.

    A session whitens rows by the sensors' noise alone until it knows better, and against that no prior counts. truth:
    as in `result_of`.
    """
    batch = _batch(attempt, chosen)
    values, stds = batch.values, np.sqrt(np.diag(batch.covariance))
    base, known = attempt.rows.base, truth or {}
    true = [*true_parameters(base, truth), *(known.get(p.name, np.nan) for p in batch.parameters[base.n :])]
    columns = (values, stds, identifiable(values, stds), np.array(true))
    return [
        Parameter(p.name, p.symbol, p.unit, value, std, determined, nominal=p.nominal or None, true=finite(true_value))
        for p, value, std, determined, true_value in zip(
            batch.parameters, *(column.tolist() for column in columns), strict=True
        )
    ]


@dataclass(frozen=True)
class _Batch:
    """Parameters of the model and of the effects chosen (k,), with values and covariance (k, k) from all rows.

    shapes: deviations of shape constants, by key of the effect and name; those of the others include their error.
    """

    parameters: list[ModelParameter]
    values: Array
    covariance: Array
    shapes: dict[tuple[str, str], float]


def _batch(attempt: Attempt, chosen: Sequence[int]) -> _Batch:
    columns = [*attempt.fixed, *(attempt.tracing.candidates[k] for k in chosen)]
    parameters = [*attempt.rows.base.parameters, *(p for candidate in columns for p in candidate.parameters)]
    constants = {p.name for candidate in attempt.fixed for p in candidate.parameters}
    kept = [k for k, p in enumerate(parameters) if p.name not in constants]
    shapes, moved = slopes(attempt.tracing, attempt.make, chosen)
    covariance = attempt.tracing.covariance(chosen, moved)
    # Rows that leave more than noise determine coefficients no better than the blocks of the session agree on them.
    white, blocks = np.sqrt(np.diag(covariance)), np.zeros(len(covariance))
    blocks[: len(parameters)] = attempt.tracing.spread(chosen)
    wider = np.maximum(1.0, np.divide(blocks, white, out=np.ones_like(white), where=np.isfinite(white) & (white > 0.0)))
    covariance = covariance * wider * wider[:, None]
    stds = np.sqrt(np.diag(covariance)[len(parameters) :]).tolist()
    known = {shape: std for shape, std in zip(shapes, stds, strict=True) if np.isfinite(std)}
    values = attempt.solution(chosen)[kept]
    return _Batch([parameters[k] for k in kept], values, covariance[np.ix_(kept, kept)], known)
