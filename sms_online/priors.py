"""What is known of the base parameters before a session, from what a system file says about the physical ones."""

from __future__ import annotations

import numpy as np

from sms_online.description.explain import hint, nearest
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.model.base_parameters import BaseParameters
from sms_online.trackers.interface import Prior

# --prior trusts a maker's nominal value to a tenth.
NOMINAL_RELATIVE_STD = 0.1


def base_prior(system: System, base: BaseParameters, nominal: bool) -> Prior:
    """Prior of the base parameters β = π_independent + mixture π_dependent, NaN where nothing is known.

    Physical parameters have the priors that the system file states; with `nominal`, the others their nominal value ±
    10 %; a combination that is nominally 0 has none, for that only says that it is not described. A combination has a
    prior where every parameter in it has one; their errors count as independent. Raises InputError for a prior of a
    parameter that there is not.
    """
    names = [parameter.name for parameter in base.physical]
    value, std = np.full((2, len(names)), np.nan)
    if nominal:
        value[:] = [parameter.nominal for parameter in base.physical]
        std = NOMINAL_RELATIVE_STD * np.abs(value)
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
    return Prior(mixing @ value, np.sqrt(np.where(variance > 0.0, variance, np.nan)))
