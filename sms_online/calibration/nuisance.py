"""What a description may be wrong in within its tolerances, and what is known of it beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sms_online.stream import Array
from sms_online.trackers.factor import triangular_factor
from sms_online.trackers.information import Information

# What is measured out with a rule is wrong by so many tolerances at most, whatever samples seem to say.
BOUNDED = ("tracked_point", "length", "axis", "gravity", "marker_station", "camera_scale")
BOUND = 30.0


@dataclass(frozen=True)
class Nuisance:
    """One number that the description takes as zero.

    name: field of `schema.Tolerances`. where: `base`, `joint_i`, `link_i`, a channel or a device; part: which of
    several there. unit: SI. tolerance: 1σ of what it may be, inf where nothing is known of it.
    """

    name: str
    where: str
    unit: str
    tolerance: float
    part: str = ""

    @property
    def may_give_way(self) -> bool:
        """Whether samples that clearly contradict its tolerance release it; else it counts as stated.

        A gain sets the scale of what a torque explains: it could make the torque zero. A share of what more elements
        change is none far beyond one, whatever else looks like it.
        """
        return self.name not in ("drive_gain", "drive_offset", "truncation")


def known_beforehand(nuisances: Sequence[Nuisance], n: int) -> Information:
    """Zero within their tolerances, as information on them and then on n parameters, of which nothing is known."""
    rows = prior_rows(nuisances, n)
    if not len(rows):
        return Information.none(rows.shape[1] - 1)
    return Information(triangular_factor(rows), len(rows))


def prior_rows(nuisances: Sequence[Nuisance], n: int) -> Array:
    """The same as rows [N Y b] (k, m + n + 1) of unit variance, one for each of k that have a tolerance."""
    tolerance = np.array([each.tolerance for each in nuisances])
    finite = np.flatnonzero(np.isfinite(tolerance))
    rows = np.zeros((finite.size, tolerance.size + n + 1))
    rows[np.arange(finite.size), finite] = 1.0 / tolerance[finite]
    return rows


def bound_rows(nuisances: Sequence[Nuisance], n: int) -> Array:
    """The bounds of `BOUNDED` as rows [N Y b] (k, m + n + 1) of unit variance."""
    wide = [BOUND * each.tolerance if each.name in BOUNDED else np.inf for each in nuisances]
    return prior_rows([replace(each, tolerance=width) for each, width in zip(nuisances, wide, strict=True)], n)
