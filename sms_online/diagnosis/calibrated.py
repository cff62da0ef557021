"""Calibration beside a search: what the description may be off by, in the columns and tolerances of a session.

Within its tolerance a number of the description explains what it can, and no effect is needed for it. An estimate
beyond `LIMIT` tolerances is no matter of the tolerance. Where the catalogue has an effect for it (a late sensor, an
encoder's zero), the number is held at zero then and the effect competes for all of it. The other numbers, of geometry
and camera, are penalised by their tolerances throughout.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np

from sms_online.calibration.multiplied_noise import Multiplied
from sms_online.calibration.nuisance import Nuisance
from sms_online.description.schema import Effect, System
from sms_online.effects.catalogue import ENTRIES, places
from sms_online.stream import Array, Mask

# One number in eighty is further off than its tolerance says by chance.
LIMIT = 2.5
# A number that is held at zero counts as known to this share of its tolerance.
HELD = 1e-6


def covered(system: System) -> frozenset[str]:
    """Tolerances that effects of the catalogue say in a system: where a parameter is known, not what is relative."""
    entries = (each for each in ENTRIES.values() if system.scale_tolerance is not None or not each.relative_to)
    return frozenset(name for entry in entries for name in entry.traits.calibrates if places(system, entry.at))


@dataclass(frozen=True)
class Calibrated:
    """Nuisances (m) with their columns (W, n_v, m) in the rows, as `SessionRows` has them once it is whitened.

    covered: see that function. multiplied: what they and gains of torques multiply, with rows of synthetic noise
    (W, n_v, ·, SAMPLES) of each, see `MultipliedNoise`.
    """

    nuisances: tuple[Nuisance, ...]
    columns: Array
    covered: frozenset[str]
    multiplied: tuple[Multiplied, ...]
    synthetic: Array

    @classmethod
    def of(
        cls, nuisances: Sequence[Nuisance], columns: Array, system: System,
        multiplied: Sequence[Multiplied], synthetic: Array,
    ) -> Calibrated:  # fmt: skip
        """Nuisances that have a tolerance: where nothing is known, as of a torque's zero, the effect replaces them."""
        known = [k for k, each in enumerate(nuisances) if np.isfinite(each.tolerance)]
        moved = tuple(
            each if each.column is None else replace(each, column=known.index(each.column)) for each in multiplied
        )
        return cls(tuple(nuisances[k] for k in known), columns[..., known], covered(system), moved, synthetic)

    @classmethod
    def none(cls, rows: Array) -> Calibrated:
        """Nothing that the description may be off by, in rows (W, n_v)."""
        nothing = np.empty((*rows.shape, 0))
        return cls((), nothing, frozenset(), (), nothing[..., None])

    @property
    def count(self) -> int:
        """Number of nuisances m."""
        return len(self.nuisances)

    @property
    def tolerance(self) -> Array:
        """1σ of each (m,)."""
        return np.array([each.tolerance for each in self.nuisances])

    def information(self, held: Mask) -> Array:
        """Rows (m, m) of unit variance of what is known of them; held (m,): those at zero."""
        return np.diag(1.0 / (self.tolerance * np.where(held, HELD, 1.0)))

    def replaced_by(self, effects: Iterable[Effect]) -> Mask:
        """Which of them (m,) the effects replace: an effect in the model leaves no second unknown for the same."""
        effects = list(effects)
        return np.array([any(_replaces(effect, each) for effect in effects) for each in self.nuisances], dtype=np.bool_)

    def tolerates(self, constant: Effect) -> bool:
        """Whether a zero or an eccentricity is no more than what is tolerated of a position sensor anyway."""
        if ENTRIES[constant.name].kind != "channel":
            return False
        own = [each.tolerance for each in self.nuisances if _replaces(constant, each) and each.name != "clock"]
        # A channel's effect is declared by its size first, in the unit of the channel.
        size = constant.coefficients[next(iter(ENTRIES[constant.name].coefficients))]
        return bool(own) and abs(size) <= LIMIT * max(own)

    def beyond(self, values: Array) -> Mask:
        """Which of them (m,) an effect of the catalogue has to replace, for estimates (m,)."""
        said = np.array([each.name in self.covered for each in self.nuisances], dtype=np.bool_)
        return np.asarray(said & (np.abs(values) > LIMIT * self.tolerance))

    def released(
        self, effects: Iterable[Effect], rows: Array, fitted: Callable[[Array, Array], Array]
    ) -> tuple[Mask, Array]:
        """Which of them (m,) are held at zero beside effects, and the solution (n + m,) with these held.

        rows (M, n + m + 1): all columns, theirs last, and the right-hand side, without what is known of them. fitted:
        solves columns and a right-hand side.
        """
        m, held = self.count, self.replaced_by(effects)
        # Only what is known of them changes: all other rows are reduced once.
        others, known = np.linalg.qr(rows, mode="r"), np.zeros((m, rows.shape[1]))
        while True:
            known[:, known.shape[1] - m - 1 : -1] = self.information(held)
            both = np.concatenate((others, known))
            solution = fitted(both[:, :-1], both[:, -1])
            beyond = self.beyond(solution[solution.size - m :]) & ~held
            if not beyond.any():
                return held, solution
            held = held | beyond


def _replaces(effect: Effect, nuisance: Nuisance) -> bool:
    """Whether an effect replaces a nuisance; places of clocks are groups of channels."""
    if nuisance.name not in ENTRIES[effect.name].traits.calibrates:
        return False
    return nuisance.name == "clock" or fnmatchcase(nuisance.where, effect.where)
