"""Coefficients of an effect that was found, as a person reads them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.description.schema import Effect
from sms_online.diagnosis.constants import deviations
from sms_online.effects.base import report
from sms_online.model.model import Model
from sms_online.model.parameters import Parameter
from sms_online.stream import Array

# Value and 1σ by name; None where it has none.
Coefficients = dict[str, tuple[float, float | None]]


def of_constant(effect: Effect, covariance: Array) -> Coefficients:
    """Coefficients of a constant, for the covariance (c, c) of its change."""
    stds = deviations(effect, covariance)
    return {name: (value, stds.get(name)) for name, value in effect.coefficients.items()}


def of_unknowns(
    effect: Effect, own: Sequence[Parameter], model: Model, names: Sequence[str], values: Array, covariance: Array
) -> Coefficients:
    """Coefficients of an effect whose unknowns `own` are among parameters `names` (n,), with values and covariance.

    A shape constant has no deviation.
    """
    covariance = np.where(np.isfinite(covariance), covariance, 0.0)
    for force in model.effects:
        if force.key == effect.key:
            # What only a combination of parameters is known of counts as zero in the others' favour.
            wanted = [*(p.name for p in force.parameters), *force.relative_to]
            absent = [name for name in wanted if name not in names]
            more = (0, len(absent))
            reported = report(force, [*names, *absent], np.pad(values, more), np.pad(covariance, more))
            return {name: (value, None if name in force.shapes else std) for name, (value, std) in reported.items()}
    places = [list(names).index(p.name) for p in own]
    return {p.quantity: (float(values[k]), float(np.sqrt(covariance[k, k]))) for p, k in zip(own, places, strict=True)}
