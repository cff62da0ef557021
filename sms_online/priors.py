"""Priors of the base parameters, from those that a system file states for the physical ones.

And the way back: estimates of base parameters as entries of a system file for the physical ones they are named after.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sms_online.description.explain import hint, nearest
from sms_online.description.schema import Fitted, System
from sms_online.effects.build import build_model
from sms_online.errors import InputError
from sms_online.model.base_parameters import BaseParameters, find_base_parameters
from sms_online.result import Parameter, Result
from sms_online.stream import Array
from sms_online.trackers.interface import Prior
from sms_online.triangle import symmetric

# --prior trusts a maker's nominal value to a tenth.
NOMINAL_RELATIVE_STD = 0.1
# What may be known beforehand: nothing, nominal values, or earlier results, their document or the way to it.
GivenPrior = bool | Result | Mapping[str, Any] | str | Path
# Quantities that are components of a whole.
VECTORS = ("first_moment_", "inertia_")


def given_prior(prior: GivenPrior) -> bool | dict[str, Any]:
    """What a session knows beforehand: whether nominal values, or what it needs of earlier results.

    As plain JSON types. Raises InputError where a path leads to no results of a session.
    """
    if isinstance(prior, bool):
        return prior
    if isinstance(prior, str | Path):
        from sms_adapters.runs import read_results

        prior = read_results(Path(prior))
    document = prior.document() if isinstance(prior, Result) else prior
    if "covariance" not in document:
        raise InputError("--prior", "covariance", "none", "results of this version: replay the recording once more")
    parameters = [{key: each[key] for key in ("name", "estimate")} for each in document["parameters"]]
    return {"system": document["system"], "parameters": parameters, "covariance": document["covariance"]}


def known_beforehand(system: System, base: BaseParameters, prior: bool | Mapping[str, Any]) -> Prior | None:
    """Prior of the base parameters, None where nothing is known; see `base_prior`."""
    return base_prior(system, base, prior) if prior or system.priors else None


def base_prior(system: System, base: BaseParameters, prior: bool | Mapping[str, Any]) -> Prior:
    """Prior of the base parameters β = π_independent + mixture π_dependent, NaN where nothing is known.

    prior: see `given_prior`. What earlier results have determined is known with their covariance, and nothing that the
    system file states of the same combination counts beside it. Raises InputError as `stated_prior`.
    """
    stated = stated_prior(system, base, nominal=prior is True)
    if isinstance(prior, bool):
        return stated
    earlier = find_base_parameters(build_model(System.model_validate(prior["system"])))
    names = [each["name"] for each in prior["parameters"]]
    covariance = symmetric(np.array([np.nan if each is None else each for each in prior["covariance"]]))
    combinations = dict(zip((p.name for p in earlier.parameters), _combinations(earlier), strict=True))
    found = {}
    for k, (parameter, own) in enumerate(zip(base.parameters, _combinations(base), strict=True)):
        if combinations.get(parameter.name) != own or parameter.name not in names:
            continue
        place = names.index(parameter.name)
        if covariance[place, place] > 0.0:
            found[k] = place
    value, std, correlation = stated.value.copy(), stated.std.copy(), np.eye(base.n)
    here, there = list(found), list(found.values())
    value[here] = [prior["parameters"][place]["estimate"] for place in there]
    std[here] = np.sqrt(np.diag(covariance)[there])
    correlation[np.ix_(here, here)] = covariance[np.ix_(there, there)] / np.outer(std[here], std[here])
    return Prior(value, std, correlation)


def _combinations(base: BaseParameters) -> list[dict[str, float]]:
    """Each base parameter as physical ones with their coefficients, rounded to what two descriptions may differ by."""
    names = [parameter.name for parameter in base.physical]
    return [
        {names[index]: 1.0} | {names[d]: round(c, 9) for d, c in zip(base.dependent, row, strict=True) if round(c, 9)}
        for index, row in zip(base.independent, base.mixture.tolist(), strict=True)
    ]


def stated_prior(system: System, base: BaseParameters, nominal: bool) -> Prior:
    """Prior of the base parameters from what a system file states, NaN where nothing is known.

    Physical parameters have the priors that the system file states; with `nominal`, those that an earlier session has
    found what that states of their whole combination, and the others their nominal value ± 10 %, components of a first
    moment or an inertia ± 10 % of the whole; what is nominally 0 otherwise has none, for that only says that it is not
    described. Any other combination has a prior where every parameter in it has one; their errors
    count as independent. Raises InputError for a prior of a parameter that does not exist.
    """
    names = [parameter.name for parameter in base.physical]
    value, std = np.full((2, len(names)), np.nan)
    if nominal:
        value[:] = [parameter.nominal for parameter in base.physical]
        std = NOMINAL_RELATIVE_STD * _sizes(base)
    for name, prior in system.priors.items():
        if name not in names:
            expected = f"the name of a parameter of this system{hint(nearest(name, names))}"
            raise InputError(system.name, f'prior."{name}"', "no such parameter", expected)
        value[names.index(name)], std[names.index(name)] = prior.value, prior.std
    value[np.isnan(std)] = 0.0
    mixing = np.zeros((base.n, len(names)))
    mixing[np.arange(base.n), list(base.independent)] = 1.0
    mixing[:, list(base.dependent)] = base.mixture
    variance = np.where(mixing != 0.0, mixing**2 * std**2, 0.0).sum(axis=1)
    if nominal:
        for row, index in enumerate(base.independent):
            if names[index] in system.fitted:
                variance[row] = (system.fitted[names[index]].std or np.nan) ** 2
    return Prior(mixing @ value, np.sqrt(np.where(variance > 0.0, variance, np.nan)))


def _sizes(base: BaseParameters) -> Array:
    """Nominal sizes of physical parameters, of vectors and matrices as a whole; NaN where nothing is described."""
    wholes = [
        parameter.name.rsplit("_", 1)[0] if parameter.quantity.startswith(VECTORS) else parameter.name
        for parameter in base.physical
    ]
    squares: dict[str, float] = {}
    for whole, parameter in zip(wholes, base.physical, strict=True):
        squares[whole] = squares.get(whole, 0.0) + parameter.nominal**2
    sizes = np.sqrt([squares[whole] for whole in wholes])
    return np.where(sizes > 0.0, sizes, np.nan)


def with_estimates(system: System, base: BaseParameters, parameters: Mapping[str, Parameter]) -> System:
    """The system with estimates of its base parameters (by name) and their deviations as its fitted values.

    Each is that of the parameter which its combination is named after, what is lumped into it being as described.
    """
    lumped = base.mixture @ np.array([base.physical[index].nominal for index in base.dependent])
    fitted = dict(system.fitted)
    for combination, index, rest in zip(base.parameters, base.independent, lumped.tolist(), strict=True):
        if combination.name in parameters:
            found = parameters[combination.name]
            std = found.std if 0.0 < found.std < np.inf else None
            fitted[base.physical[index].name] = Fitted(value=found.value - rest, std=std)
    return system.model_copy(update={"fitted": fitted})
