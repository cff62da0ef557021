"""Which rows hold a torque of unknown gain, and which columns are torques times a gain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.calibration.nuisance import Nuisance
from sms_online.effects.base import joints_of
from sms_online.effects.catalogue import ENTRIES
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.effect import ForceEffect
from sms_online.model.model import Model
from sms_online.stream import Array, Mask

GAIN = "drive_gain"


def gain_columns(model: Model, base: BaseParameters, nuisances: Sequence[Nuisance]) -> list[int]:
    """Columns of [N Y] that are torques: their gains as matters of calibration, and as declared effects."""
    calibrated = [k for k, each in enumerate(nuisances) if each.name == GAIN]
    places = [place for _, columns in _declared(model) for place in range(columns.start, columns.stop)]
    return calibrated + [len(nuisances) + k for k, place in enumerate(base.independent) if place in places]


def plausible_gains(model: Model, base: BaseParameters, m: int) -> Array:
    """Rows [N Y b] (k, m + n + 1) of unit variance: gains as parameters are zero within what the catalogue allows.

    Where a torque is friction for the most part, the criterion has its least value at no gain that is one.
    """
    rows = np.zeros((0, m + base.n + 1))
    for effect, columns in _declared(model):
        for k in np.flatnonzero(np.isin(base.independent, np.arange(columns.start, columns.stop))):
            row = np.zeros(m + base.n + 1)
            row[m + k] = 1.0 / ENTRIES[effect.name].traits.most
            rows = np.vstack((rows, row))
    return rows


def gained(model: Model) -> Mask:
    """Which speeds' rows (n_v,) hold a torque whose gain is an unknown of the model.

    Such a row is homogeneous in the gain and in the other parameters: as in the rows of a link, all of them shrinking
    together lowers what is left.
    """
    unknown = [model.layout.theta_m[i] for effect, _ in _declared(model) for i in joints_of(effect.where)]
    return np.isin(np.arange(model.layout.n_v), unknown)


def _declared(model: Model) -> list[tuple[ForceEffect, slice]]:
    """Declared gains with their places in π."""
    # Measured wrenches are forces of the model as well, and none of the catalogue's.
    names = {name for name, entry in ENTRIES.items() if GAIN in entry.traits.calibrates}
    effects = zip(model.effects, model.effect_slices, strict=True)
    return [(effect, columns) for effect, columns in effects if effect.name in names]
