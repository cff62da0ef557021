"""What the rest of the program asks of an effect beside its law, so that only the catalogue asks for one by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sms_online.stream import Array

# How a force follows the motion: as smoothly as the motion itself, which is thinned then; not so, so that it is made
# from every sample; jumping with the sign of a motor's rate; and dry: jumping, and at a standstill any value up to that
# of its law, which says no more.
Course = Literal["smooth", "rough", "reversing", "dry"]
# What a force is drawn over where it is a function of one variable.
Variable = Literal["motor speed", "motor angle", "deflection", "phase in the motor's turn", "torque"]
# No law of a force is true to better than 0.3 %, and what it leaves of its own gain is no other effect on its rows.
INEXACT = 1e-5
# Dry friction changes its sign by creeping, not in a step, and repeats to a few percent: Armstrong-Hélouvry, Dupont and
# Canudas de Wit, Automatica 30 (1994) 1083.
INEXACT_DRY = 1e-3


@dataclass(frozen=True)
class Curve:
    """How the force of an effect at a joint is drawn.

    between: whether it acts between motor and link side; else on the motor's side alone.
    """

    over: Variable
    between: bool = False


@dataclass(frozen=True)
class Traits:
    """Properties of an effect; the defaults are those of a force that takes power out.

    signed: whether linear coefficients may be negative. Those of what takes power out, stores it, has a mass or comes
    late may not. least, most: norm of the linear coefficients; a fit that needs others is of something else. behind: of
    a delay in s, the samples that it has to exceed. curve: None where the force is not a function of one variable.
    extends: name of a simpler effect that this one contains, which is tried first, as is everything else. begins:
    whether it is tried where something changes while a session runs, at any joint. calibrates: the
    fields of `Tolerances` that a declaration at the same place says, for it is the same column. limits: of
    coefficients as a person reads them, least and most, where what they are relative to decides. learned: whether it is
    a curve, tried where no law is selected. least_improvement: share by which it has to lower the rms of the held-out
    rows that it acts on; on measured rigs laws that gained less within a run were as likely to harm another run as to
    help it.
    """

    signed: bool = False
    least: float = 0.0
    most: float = np.inf
    behind: float | None = None
    course: Course = "rough"
    curve: Curve | None = None
    extends: str | None = None
    begins: bool = False
    calibrates: tuple[str, ...] = ()
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    learned: bool = False
    least_improvement: float = 0.10

    @property
    def reversing(self) -> bool:
        """Whether the force jumps with the sign of a motor's rate."""
        return self.course in ("reversing", "dry")

    @property
    def dry(self) -> bool:
        """Whether the force at a standstill is any value up to that of its law."""
        return self.course == "dry"

    @property
    def inexact(self) -> float:
        """Share of its own gain that the law leaves in its rows, for want of truth."""
        return INEXACT_DRY if self.dry else INEXACT

    def plausible(self, coefficients: Array, sample_rate: float) -> bool:
        """Whether the effect can have these linear coefficients (c,) on samples at so many Hz."""
        if not self.signed and np.any(coefficients < 0.0):
            return False
        if self.behind is not None and coefficients[0] <= self.behind / sample_rate:
            return False
        return bool(self.least <= np.linalg.norm(coefficients) <= self.most)

    def within(self, reported: Mapping[str, float]) -> bool:
        """Whether coefficients as a person reads them are possible; not where any that has a limit is missing."""
        return all(name in reported and least <= reported[name] <= most for name, (least, most) in self.limits.items())
