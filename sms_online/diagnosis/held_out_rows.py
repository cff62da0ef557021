"""Blocks of a session's rows predicted from the others: what held-out rows leave of a model with some candidates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.diagnosis.candidate_fits import Key
from sms_online.diagnosis.candidate_rows import CandidateRows
from sms_online.diagnosis.evidence import least_squares_without
from sms_online.stream import Array, Mask

# Rows without a torque whose terms are smaller than this share of their usual size have drawn the parameters to zero.
SHRUNK = 0.1


class HeldOutRows(CandidateRows):
    """Solutions without each block of a session, and what they leave of it."""

    def solutions(self, chosen: Sequence[int], beside: Sequence[int] | None = None) -> Array:
        """The same without each part of the windows in turn, (parts, n + c + m)."""
        known = np.zeros(len(self._b) - self.rows.b.size, dtype=bool)
        left_out = [
            np.concatenate((np.repeat(~self.folds.fitted(k), self._n_v), known)) for k in range(self.folds.parts)
        ]
        columns, positive = self._columns(chosen, beside), self.bounds(chosen)
        # What is zero for all windows together is so for those without a part.
        free = ~(positive & (self.solution(chosen, beside) == 0.0))
        out = np.zeros((len(left_out), free.size))
        out[:, free] = least_squares_without(columns[:, free], self._b, left_out, positive[free])
        return out

    def predicted(self, chosen: Sequence[int], solutions: Array) -> Array:
        """What is left of every row (W, n_v) over its own deviation, blocks predicted from the others.

        solutions: without each of the blocks.
        """
        left = self.residual(chosen, self.solution(chosen))
        for k, solution in enumerate(solutions):
            held = self.folds.predicted(k)
            left[held] = self.residual(chosen, solution)[held]
        return left

    def _sized(self, chosen: Sequence[int], solution: Array, beside: Sequence[int] | None) -> Array:
        """What is left (W, n_v), rows without a torque whitened, and as if they had their usual size.

        The noise of neighbouring windows has much in common, and a force that is smaller may be clear beside it. Size
        counts where rows leave more than noise whatever is added, and where a fit that lacks something has shrunk them.
        """
        left = self.residual(chosen, solution)
        if not self.floor.any():
            white = (self._b - self._columns(chosen, beside) @ solution)[: left.size].reshape(left.shape)
            left[:, self._scale.homogeneous] = white[:, self._scale.homogeneous]
        if np.any(self._scale.homogeneous):
            terms = self._terms(chosen, solution)
            sized = (self._homogeneous | self._shrunk(terms)) & (terms > 0.0)
            left[:, sized] *= np.sqrt(self._usual[sized] / terms[sized])
        return left

    def _shrunk(self, terms: Array) -> Mask:
        """Speeds (n_v,) whose rows have no torque and terms of these sums of squares (n_v,) that are far too small."""
        return np.asarray(self._scale.homogeneous & (terms < SHRUNK**2 * self._usual))

    def shrinks(self, chosen: Sequence[int]) -> bool:
        """Whether the fit beside those chosen shrinks the parameters: its rows hold more than noise, and draw them."""
        return bool(np.any(self._shrunk(self._terms(chosen, self.solution(chosen)))))

    def held_out(self, chosen: Sequence[int], beside: Sequence[int] | None = None) -> Array:
        """Sums of squares of held-out rows by block and speed, (B, n_v), relative where they leave more than noise.

        Kept as solutions are: every candidate beside the same others asks for those of the others.
        """
        key = self._key(chosen, beside)
        if key not in self._held_out:
            left = self._sized(chosen, self.solution(chosen, beside), beside)
            for k, solution in enumerate(self.solutions(chosen, beside)):
                held = self.folds.predicted(k)
                left[held] = self._sized(chosen, solution, beside)[held]
            self._held_out[key] = self._by_block(left)
        return self._held_out[key]

    def fitted(self, chosen: Sequence[int], beside: Sequence[int] | None = None) -> Array:
        """The same sums of the fit to all rows."""
        key = self._key(chosen, beside)
        if key not in self._fitted:
            self._fitted[key] = self._by_block(self._sized(chosen, self.solution(chosen, beside), beside))
        return self._fitted[key]

    def _by_block(self, left: Array) -> Array:
        squares = (left * self.std / self._counted) ** 2
        return np.array([squares[self.folds.held(k)].sum(axis=0) for k in range(self.folds.count)])

    def spread(self, chosen: Sequence[int]) -> Array:
        """Deviations (n + c,) of the solution by the jackknife over the parts, whatever rows hold beside noise."""
        solutions = self.solutions(chosen)
        n = len(solutions)
        squares = np.sum((solutions - solutions.mean(axis=0)) ** 2, axis=0)
        return np.asarray(np.sqrt((n - 1) / n * squares))[: squares.size - self.calibrated.count]

    def _forget(self) -> None:
        """See `CandidateFits`."""
        super()._forget()
        self._held_out: dict[Key, Array] = {}
        self._fitted: dict[Key, Array] = {}
