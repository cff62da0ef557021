"""Which rows hold a torque that fixes the scale of their parameters, and which columns are torques times a gain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sms_online.calibration.nuisance import Nuisance
from sms_online.effects.base import joints_of
from sms_online.effects.catalogue import ENTRIES
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model

GAIN = "drive_gain"


def gain_columns(model: Model, base: BaseParameters, nuisances: Sequence[Nuisance]) -> list[int]:
    """Columns of [N Y] that are torques: their gains as matters of calibration, and as declared effects."""
    calibrated = [k for k, each in enumerate(nuisances) if each.name == GAIN]
    places = [place for _, columns in _declared(model) for place in range(columns.start, columns.stop)]
    return calibrated + [len(nuisances) + k for k, place in enumerate(base.independent) if place in places]


def fixed_torques(model: Model) -> NDArray[np.bool_]:
    """Which speeds' rows (n_v,) hold a torque whose gain is known to a tolerance.

    Where a gain is an unknown of the model, a row is homogeneous in it and in the other parameters: as in the rows of a
    link, all of them shrinking together lowers what is left.
    """
    layout = model.layout
    unknown = [layout.theta_m[i] for joints, _ in _declared(model) for i in joints]
    speeds = np.arange(layout.n_v)
    return np.isin(speeds, layout.theta_m) & ~np.isin(speeds, unknown)


def _declared(model: Model) -> list[tuple[Sequence[int], slice]]:
    """Joints and places in π of declared gains."""
    effects = zip(model.effects, model.effect_slices, strict=True)
    return [(joints_of(e.where), columns) for e, columns in effects if GAIN in ENTRIES[e.name].traits.calibrates]
