"""A model with effects against the rows of a session: the search and the verdict of captures and running sessions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.description.schema import Effect
from sms_online.diagnosis.candidate import Candidate
from sms_online.diagnosis.candidates import CandidateColumns
from sms_online.diagnosis.constants import improved
from sms_online.diagnosis.folds import Folds
from sms_online.diagnosis.residuals import RowResidual
from sms_online.diagnosis.shape import refine
from sms_online.diagnosis.trace import MOST_EFFECTS, Tracing
from sms_online.effects.possible import not_negative
from sms_online.effects.traits import INEXACT
from sms_online.row_types import row_types
from sms_online.stream import Array
from sms_online.trackers.interface import Prior

# Constants have converged when they move by less than this share of their deviation.
CONVERGED = 0.1
# Times that constants are improved, each with samples corrected by those found before.
CORRECTIONS = 3
# Times at most that rows are whitened anew by what was found, to search again.
REWEIGHED = 2
# A verdict names effects that take away all but this share of what is beyond noise: a wrong one that is 10° from the
# right one leaves sin² 10°.
LARGEST_SHARE_LEFT = 0.03
# No right effect leaves a row type more than this multiple of its noise, unless that is what its law is uncertain by.
MOST_LEFT = 2.0
# Effects that are looked for in turn on arms of many joints: each may have friction, and one more.
EFFECTS_A_JOINT = 2


class Hypothesis:
    """A model, constants that its samples are corrected by, and candidates for what it lacks, against a session's rows.

    make: of candidates. constants: with fixed, their columns: of what they are still off by. tracing: the search.
    """

    def __init__(
        self,
        make: CandidateColumns,
        candidates: Sequence[Candidate],
        folds: Folds,
        prior: Prior | None,
        constants: Sequence[Effect] = (),
    ) -> None:
        """folds: blocks of the windows (W,) that are held out in turn."""
        self.make, self.rows = make, make.rows
        self.prior, self.folds = prior, folds
        self.constants = list(constants)
        self.trace(candidates)

    def trace(self, candidates: Sequence[Candidate]) -> None:
        """Begin to search with the weights that the rows have now."""
        self.fixed = [self.make.of(effect) for effect in self.constants]
        model = self.rows.model
        self.tracing = Tracing(
            self.rows,
            candidates,
            self.folds,
            self.prior,
            self.fixed,
            self.make,
            declared=(effect.key for effect in model.system.effects),
            types=row_types(model.layout).values(),
            of_effects=["@" in p.name for p in self.rows.base.parameters],
            positive=[not_negative(p.name) for p in self.rows.base.parameters],
            calibrated=self.rows.calibrated,
            inertial=np.isin(self.rows.base.independent, model.inertial).tolist(),
        )

    def run(self, begun: Sequence[Effect] = ()) -> list[int]:
        """Numbers of the candidates found, with the rows' weights as they are; begun: effects to go on from."""
        start = [k for k, candidate in enumerate(self.tracing.candidates) if candidate.effect in begun]
        most = max(MOST_EFFECTS, EFFECTS_A_JOINT * len(self.rows.model.system.joints))
        return self.tracing.run(lambda chosen, k: refine(self.tracing, self.make, chosen, k), self.watch, start, most)

    def watch(self, chosen: Sequence[int]) -> bool:
        """Whether to end the search with those chosen so far."""
        return False

    @property
    def everything(self) -> range:
        """Numbers of all candidates."""
        return range(len(self.tracing.candidates))

    def solution(self, chosen: Sequence[int]) -> Array:
        """Parameters, what constants change by, coefficients, and calibration, from all windows."""
        return self.tracing.solution(chosen)

    def residual(self, chosen: Sequence[int]) -> Array:
        """What is left of every row (W, n_v) over its deviation."""
        return self.tracing.residual(chosen, self.solution(chosen))

    def excess(self, chosen: Sequence[int]) -> float:
        """Sum of squares that is left beyond noise."""
        residual = self.residual(chosen)
        return float(np.sum(residual**2) - residual.size)

    def places(self, candidates: Sequence[Candidate]) -> list[slice]:
        """Where a solution holds the coefficients of constants and then of candidates chosen, one after the other."""
        sizes = [len(each.parameters) for each in (*self.fixed, *candidates)]
        ends = self.rows.base.n + np.cumsum([0, *sizes])
        return [slice(start, end) for start, end in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)]

    def improved(self, solution: Array) -> list[Effect]:
        """The constants improved by a solution."""
        places = self.places([])
        return [improved(effect, solution[own]) for effect, own in zip(self.constants, places, strict=True)]

    def converged(self, solution: Array) -> bool:
        """Whether there is nothing more to improve in the constants."""
        n = self.rows.base.n
        own = slice(n, n + sum(len(candidate.parameters) for candidate in self.fixed))
        std = np.sqrt(np.diag(self.tracing.covariance(self.everything))[own])
        return bool(np.all(np.abs(solution[own]) < CONVERGED * std))

    def found(self, chosen: Sequence[int], solution: Array) -> tuple[list[Effect], list[Effect]]:
        """The chosen effects that become constants, with their values, and the other chosen ones."""
        candidates = [self.tracing.candidates[k] for k in chosen]
        places = self.places(candidates)[len(self.fixed) :]
        constants = [improved(c.effect, solution[own]) for c, own in zip(candidates, places, strict=True) if c.constant]
        return constants, [candidate.effect for candidate in candidates if not candidate.constant]


@dataclass(frozen=True)
class ConstantsStep:
    """One improvement of constants: its hypothesis, its solution (n + c,), and the constants improved."""

    hypothesis: Hypothesis
    solution: Array
    constants: list[Effect]

    @property
    def misfit(self) -> float:
        """Sum of squares that is left beyond noise, and of what calibration takes over its tolerances.

        Calibration that is free to explain what a constant leaves would make any two of them equal.
        """
        calibrated = self.hypothesis.rows.calibrated
        taken = self.solution[self.solution.size - calibrated.count :] / calibrated.tolerance
        return self.hypothesis.excess(self.hypothesis.everything) + float(taken @ taken)

    @property
    def converged(self) -> bool:
        """Whether the next one would change nothing."""
        return self.hypothesis.converged(self.solution)


def corrections(
    trial: Callable[[Sequence[Effect], Array], Hypothesis], constants: Sequence[Effect], beta: Array
) -> Iterator[ConstantsStep]:
    """Constants improved, each time with samples free of those found before.

    trial: makes the hypothesis of constants, rows whitened with beta (n,); its candidates are all chosen.
    """
    for _ in range(CORRECTIONS):
        some = trial(constants, beta)
        some.tracing.reweight(some.everything)
        solution = some.solution(some.everything)
        constants, beta = some.improved(solution), solution[: beta.size]
        yield ConstantsStep(some, solution, list(constants))


def share_left(before: float, after: float) -> float:
    """Share of what is beyond noise, a sum of squares, that is left."""
    return max(0.0, after) / max(before, 1.0)


def verdict(
    named: bool,
    left: float,
    after: Mapping[str, RowResidual],
    before: Mapping[str, RowResidual] | None = None,
    found: Sequence[Candidate] = (),
) -> str:
    """What may be said where effects were named or not, and leave this share of what was beyond noise.

    after: by row type; before, found: with the effects left out, and these, of a whole capture. A running session goes
    on with what is named and searches again, so that single rows may hold something still.
    """
    if not any(row.beyond for row in after.values()):
        return "named" if named else "clean"
    if not named or left > LARGEST_SHARE_LEFT:
        return "unexplained"
    if before is None:
        return "named"
    # Friction of a joint acts on the rows of that joint.
    for name, row in after.items():
        inexact = max((each.traits.inexact for each in found if each.effect.where == name), default=INEXACT)
        if row.whitened > MOST_LEFT and row.whitened**2 > inexact * before[name].whitened ** 2:
            return "unexplained"
    return "named"
