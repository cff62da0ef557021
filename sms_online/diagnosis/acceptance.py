"""Which effects a session supports: what they improve of held-out blocks, and what the joint fit makes of them."""

from __future__ import annotations

from collections.abc import Container, Sequence

import numpy as np

from sms_online.diagnosis.folds import Fall, fall
from sms_online.diagnosis.held_out_rows import HeldOutRows
from sms_online.stream import Array, Mask

# Coefficients of effects that are correlated by more than this are those of one effect too many.
LARGEST_CORRELATION = 0.99
# Rows that hold more than this multiple of their deviation leave more than noise.
MOST_LEFT = 2.0
# Fewest blocks from which a coefficient's deviation is estimated.
LEAST_FOLDS = 4
# Share by which an effect has to lower the rms of held-out rows where whole captures are predicted from others: on
# measured rigs laws that gained as much across two runs helped on a third.
ACROSS_CAPTURES = 0.02
# Share by which the rms of all held-out rows falls where an effect is taken whatever its own rows do.
MUCH = 0.5
# Rows of another type may rise by this share of the squares by which an effect lowers those that it acts on.
SMALL_RISE = 0.05
# A coefficient is significant beyond this multiple of its deviation.
SIGNIFICANT = 2.0


class Acceptance(HeldOutRows):
    """Tests whether held-out rows support effects, and whether a joint fit admits them."""

    def least_improvement(self, k: int) -> float:
        """Share by which a candidate has to lower the rms of the held-out rows that it acts on."""
        traits = self.candidates[k].traits
        return ACROSS_CAPTURES if self.folds.across and not traits.learned else traits.least_improvement

    def _judging(self, k: int) -> Mask:
        """Speeds (n_v,) whose rows judge a candidate: those that it acts on; for a gain, those of all torques.

        Parameters of a joint's own links follow the gain of its torque, so that rows of other joints contradict it.
        """
        acts = self._acts(k)
        return acts | np.any(self.rows.b, axis=0) if self.candidates[k].is_gain else acts

    def improves(self, chosen: Sequence[int], candidate: int) -> bool:
        """Whether a candidate beside those chosen lowers the residual of held-out rows, and no other type's rises.

        Or that of all rows together by much: what else is lacking may have drawn the fit to the rows that it acts on.
        """
        together, least = [*chosen, candidate], self.least_improvement(candidate)
        acts = self._judging(candidate)
        before, after = (self.fitted(each, chosen) for each in (chosen, together))
        if not self.floor.any() and fall(before.sum(axis=1), after.sum(axis=1)).share >= MUCH:
            held = (self.held_out(each, chosen).sum(axis=1) for each in (chosen, together))
            whole = fall(*held)
            if whole.share >= MUCH and whole.certain:
                return True
        if fall(before[:, acts].sum(axis=1), after[:, acts].sum(axis=1)).share < least:
            return False  # not even of the rows that it is fitted to
        before, after = (self.held_out(each, chosen) for each in (chosen, together))
        own = fall(before[:, acts].sum(axis=1), after[:, acts].sum(axis=1))
        # A constant is taken off to first order: the rest may raise one type until the samples are corrected.
        types = [list(range(self._n_v))] if self.candidates[candidate].constant else self._types
        if own.share < least or not own.certain:
            return False
        # Rows that noise can explain have the same measure: a rise counts there beside what falls, for on the way of a
        # forward selection others rise that its next step mends.
        counted = 0.0 if self.floor.any() else SMALL_RISE * float(np.sum((before - after)[:, acts]))
        rising = (each for each in types if float(np.sum((after - before)[:, each])) > counted)
        return not any(fall(before[:, each].sum(axis=1), after[:, each].sum(axis=1)).rises for each in rising)

    def improvement(self, chosen: Sequence[int], candidate: int) -> Fall:
        """Fall of the rms of the held-out rows that a candidate acts on, beside those chosen.

        Of calibration the same is held before and after, so that the candidate alone makes the difference.
        """
        acts = self._judging(candidate)
        before, after = (self.held_out(each, chosen) for each in (chosen, [*chosen, candidate]))
        return fall(before[:, acts].sum(axis=1), after[:, acts].sum(axis=1))

    def failing(self, chosen: Sequence[int], held: Container[int] = ()) -> int | None:
        """The weakest of the effects to drop: impossible, collinear, insignificant, or no improvement; None if none.

        held: friction that its likelihood has chosen. It takes any value while its axis is at rest, and is asked for
        its sign alone where rows leave no more than noise.
        """
        left = self.residual(chosen, self.solution(chosen))
        loud = np.mean(left**2, axis=0) > MOST_LEFT**2
        asked = [k for k in chosen if k not in held or np.any(loud & self._acts(k))]
        for fails in (self._impossible, self._collinear, self._insignificant, self._not_improving):
            if failing := fails(chosen, asked):
                return min(failing, key=lambda k: self.improvement([other for other in chosen if other != k], k).share)
        return None

    def _places(self, chosen: Sequence[int]) -> dict[int, slice]:
        """Where a solution holds the coefficients of each of those chosen."""
        sizes = [len(self.candidates[k].parameters) for k in chosen]
        ends = (self.n_model + np.cumsum(sizes)).tolist()
        return {k: slice(end - size, end) for k, size, end in zip(chosen, sizes, ends, strict=True)}

    def _impossible(self, chosen: Sequence[int], asked: Sequence[int]) -> list[int]:
        """Effects with impossible coefficients, or without which no mass or spring would be negative."""
        solution = self.solution(chosen)
        impossible = [k for k, own in self._places(chosen).items() if not self._possible(k, solution, solution[own])]
        if impossible or not self._negative(chosen):
            return impossible
        return [k for k in chosen if not self._negative([other for other in chosen if other != k])]

    def _negative(self, chosen: Sequence[int]) -> bool:
        """Whether the model has a negative mass, spring or damping in more than a few blocks."""
        n = self.n_model
        value = self.solution(chosen)[:n]
        if not np.any(self._positive & (value < 0.0)):
            return False
        return bool(np.any(self._positive & (value < -SIGNIFICANT * self.spread(chosen)[:n])))

    def _possible(self, k: int, solution: Array, own: Array) -> bool:
        candidate = self.candidates[k]
        if not candidate.traits.plausible(own, self.rows.sample_rate) or not candidate.first_order(own):
            return False
        if self._laws is None or not candidate.traits.limits:
            return True
        reported = self._laws.reported(candidate.effect, solution[: self.rows.Y.shape[2]], own)
        return candidate.traits.within(reported)

    def _collinear(self, chosen: Sequence[int], asked: Sequence[int]) -> list[int]:
        """Effects whose coefficients are collinear with those of another effect, declared or chosen."""
        covariance = self.covariance(chosen)
        std = np.sqrt(np.diag(covariance))
        known = np.isfinite(std) & (std > 0.0)
        correlation = np.where(known, covariance, 0.0) / np.where(known, std, 1.0) / np.where(known, std, 1.0)[:, None]
        places = self._places(chosen)
        effects = np.array([*self._of_effects, *np.ones(len(std) - self.n_model)], dtype=bool)
        out = []
        for k, own in places.items():
            if k not in asked:
                continue
            others = effects.copy()
            others[own] = False
            if self.candidates[k].is_gain:
                others[: self.n_model] = False  # a gain scales friction of its joint as it scales its links
            if not np.all(known[own]) or np.any(np.abs(correlation[own][:, others]) > LARGEST_CORRELATION):
                out.append(k)
        return out

    def _insignificant(self, chosen: Sequence[int], asked: Sequence[int]) -> list[int]:
        """Effects whose coefficients are no larger than their scatter over the blocks."""
        if self.folds.parts < LEAST_FOLDS:
            return []
        solution, std = self.solution(chosen), self.spread(chosen)
        places = self._places(chosen)
        return [k for k in asked if np.all(np.abs(solution[places[k]]) < SIGNIFICANT * std[places[k]])]

    def _not_improving(self, chosen: Sequence[int], asked: Sequence[int]) -> list[int]:
        """Effects that do not improve held-out rows, whitened as without them."""
        idle = []
        for k in asked:
            others = [other for other in chosen if other != k]
            if self.candidates[k].traits.dry:
                self.reweight(others)
            if self.improvement(others, k).share < self.least_improvement(k):
                idle.append(k)
            self.reweight(chosen)
        return idle
