"""A candidate for a missing effect, and what a search finds about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sms_online.description.schema import Effect
from sms_online.diagnosis.evidence import Gain
from sms_online.effects.traits import Traits
from sms_online.model.parameters import Parameter
from sms_online.pipeline.torque_gains import GAIN
from sms_online.stream import Array


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect that may be missing.

    effect: as a system file would declare it, shape constants included. parameters: its linear coefficients (c,).
    columns (W, n_v, c): what one unit of each adds to the rows. traits: of the effect. constant: whether its
    coefficients become constants of the description, no unknowns of π: see `constants`. bend: of a constant, by what
    share of its own size a unit of its coefficients differs from first order.
    """

    effect: Effect
    parameters: tuple[Parameter, ...]
    columns: Array
    traits: Traits
    constant: bool = False
    bend: float = np.inf

    def left_over(self, coefficients: Array) -> float:
        """Share of its gain that a constant with coefficients (c,) leaves while it is subtracted to first order."""
        return min(1.0, (self.bend * float(np.linalg.norm(coefficients))) ** 2) if self.constant else 0.0

    def first_order(self, coefficients: Array) -> bool:
        """Whether it can be subtracted to first order with coefficients (c,): an angle of a radian cannot."""
        return not (np.isfinite(self.bend) and self.left_over(coefficients) >= 1.0)

    @property
    def key(self) -> str:
        """name@where."""
        return self.effect.key

    @property
    def is_gain(self) -> bool:
        """Whether it is that of a torque."""
        return GAIN in self.traits.calibrates

    @property
    def extends(self) -> str | None:
        """Key of a simpler effect that it contains: it refines a law."""
        simpler = self.traits.extends
        return None if simpler is None else f"{simpler}@{self.effect.where}"


@dataclass(frozen=True)
class Unmodelled:
    """Covariance of what the law of a candidate does not determine in the rows.

    own (W, n_v): variance by noise. free (W, HOPS, n_v): covariances by forces it does not give, where the rate's
    sign changes, at a standstill, and where the rate is blurred. See `WeakWindows.shared`.
    """

    own: Array
    free: Array


class Laws(Protocol):
    """What candidates' laws do not determine."""

    def unmodelled(self, candidate: Candidate, coefficients: Array) -> Unmodelled:
        """Unmodelled covariance of the rows, for a candidate with coefficients (c,)."""

    def at_rest(self, candidate: Candidate) -> float:
        """Share of the session in which the axis of a law of dry friction is at rest."""

    def reported(self, effect: Effect, beta: Array, coefficients: Array) -> dict[str, float]:
        """Coefficients as a person reads them, for parameters β (n,) and an effect's own coefficients (c,)."""


@dataclass(frozen=True)
class Rival:
    """The candidate that lost against one that was found: key, and by what share it lowers the same held-out rms."""

    key: str
    improvement: float


@dataclass(frozen=True)
class Finding:
    """An effect that the data show.

    gain: beside everything else that was found, whitened. limit: what the best of all absent candidates would reach.
    improvement: share by which the rms of held-out rows that it acts on falls. ambiguous: keys of candidates that
    explain nearly as much in its place. rival: the best of the others in its place.
    """

    candidate: Candidate
    gain: Gain
    limit: float
    improvement: float
    ambiguous: tuple[str, ...]
    rival: Rival | None = None


@dataclass(frozen=True)
class Ranked:
    """A candidate in the first comparison: its gain alone, and the share of the whole residual that it explains.

    explained: of the squares, noise included; 0 where the gain is no more than an absent candidate's.
    """

    candidate: Candidate
    gain: float
    explained: float
