"""Fits of a model and the candidates beside it to rows that are whitened: gains, solutions and their covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sms_online.diagnosis.calibrated import Calibrated
from sms_online.diagnosis.candidate import Candidate
from sms_online.diagnosis.evidence import Gain, basis, fitted, free_of, gains
from sms_online.diagnosis.weak_rows import WeakRows
from sms_online.stream import Array, Mask
from sms_online.trackers.factor import solve

# A row is acted on where a candidate's column has at least this share of its largest row's squares.
ACTS = 0.01

# Of what is kept: numbers of those chosen, and beside which numbers of calibration are held at zero.
Key = tuple[tuple[int, ...], frozenset[int] | None]


class CandidateFits:
    """Gains and solutions of candidates beside a model, each solved once until rows are whitened anew.

    Whoever whitens the rows sets the attributes declared here; `_forget` drops what was solved before.
    """

    # White columns (M, n) of the model and (M, m) of calibration, and b (M,); of each candidate; and rows, of these M,
    # in which what is known beforehand follows the samples'.
    _Y: Array
    _N: Array
    _b: Array
    _Z: list[Array]
    _known: int
    # Standard deviation of every row (W, n_v), and the columns of model, calibration and candidates over it.
    std: Array
    _plain_model: Array
    _plain_calibration: Array
    _plain: list[Array]
    # Of each speed's rows (n_v,), what everything together leaves beyond their variance, as a share of it.
    floor: Array

    def __init__(
        self,
        rows: WeakRows,
        candidates: Sequence[Candidate],
        fixed: Sequence[Candidate],
        positive: Sequence[bool] | None,
        calibrated: Calibrated | None,
    ) -> None:
        """The arguments are those of `CandidateRows`."""
        self.calibrated = Calibrated.none(rows.b) if calibrated is None else calibrated
        self._fixed = list(fixed)
        self.rows, self.candidates = rows, list(candidates)
        self._n, self._n_v = rows.Y.shape[2], rows.Y.shape[1]
        self._model = np.concatenate([rows.Y, *(candidate.columns for candidate in fixed)], axis=2)
        self._positive = np.zeros(self._model.shape[2], dtype=bool)
        self._positive[: self._n] = False if positive is None else positive

    @property
    def n_model(self) -> int:
        """Unknowns of the model without those chosen."""
        return int(self._model.shape[2])

    def _columns(self, chosen: Sequence[int], beside: Sequence[int] | None = None) -> Array:
        """White columns of the model, of those chosen and of calibration.

        beside: those that say which of its numbers are held at zero; those chosen unless given.
        """
        if not self.calibrated.count:
            return np.concatenate([self._Y, *(self._Z[k] for k in chosen)], axis=1)
        return self._with_calibration(chosen, self.zeroed(chosen if beside is None else beside))

    def _with_calibration(self, chosen: Sequence[int], held: Mask) -> Array:
        self._N[-held.size :] = self.calibrated.information(held)
        return np.concatenate([self._Y, *(self._Z[k] for k in chosen), self._N], axis=1)

    def zeroed(self, chosen: Sequence[int]) -> Mask:
        """Which numbers of calibration (m,) are held at zero beside those chosen: effects replace them, or have to."""
        m, key = self.calibrated.count, frozenset(chosen)
        if key not in self._zeroed:
            chosen = sorted(chosen)  # whatever their order, the same to the last bit
            rows = np.column_stack((self._Y, *(self._Z[k] for k in chosen), self._N, self._b))
            self._zeroed[key], solution = self._released(chosen, rows[: len(rows) - m])
            if m:
                self._solved[tuple(chosen), None] = solution
        return self._zeroed[key]

    def _released(self, chosen: Sequence[int], rows: Array) -> tuple[Mask, Array]:
        """Which numbers of calibration (m,) are held at zero beside those chosen, and the solution (n + c + m,).

        rows (M, n + c + m + 1): all columns and the right-hand side, without what is known of calibration.
        """
        effects = [candidate.effect for candidate in (*self._fixed, *(self.candidates[k] for k in chosen))]
        return self.calibrated.released(effects, rows, lambda columns, b: self._fitted_to(chosen, columns, b))

    def gains(self, chosen: Sequence[int]) -> list[Gain]:
        """What each candidate would take beside those chosen."""
        key = tuple(chosen)
        if key not in self._gains:
            found = gains(*self.left(chosen), self._Z)
            self._gains[key] = [self._plausible(c, each) for c, each in zip(self.candidates, found, strict=True)]
        return self._gains[key]

    def left(self, chosen: Sequence[int]) -> tuple[Array, Array]:
        """Basis of the white columns of the model with those chosen, and what it leaves of b. Kept as solutions are."""
        key = tuple(chosen)
        if key not in self._bases:
            # What a bound keeps at zero gives way to nothing.
            Q = basis(self._columns(chosen)[:, ~(self.bounds(chosen) & (self.solution(chosen) == 0.0))])
            self._bases[key] = Q, free_of(Q, self._b[:, None])[:, 0]
        return self._bases[key]

    def _plausible(self, candidate: Candidate, found: Gain) -> Gain:
        """The gain, none where the effect cannot have the coefficients."""
        possible = candidate.traits.plausible(found.coefficients, self.rows.sample_rate)
        return found if possible and candidate.first_order(found.coefficients) else replace(found, gain=0.0)

    def gain_of(self, candidate: Candidate, chosen: Sequence[int]) -> Gain:
        """What any candidate would take beside those chosen."""
        return self._plausible(candidate, gains(*self.left(chosen), [self._whitened(candidate.columns)])[0])

    def _forget(self) -> None:
        """What was solved with other weights or columns."""
        self._zeroed: dict[frozenset[int], Mask] = {}
        self._solved: dict[Key, Array] = {}
        self._bases: dict[tuple[int, ...], tuple[Array, Array]] = {}
        self._gains: dict[tuple[int, ...], list[Gain]] = {}
        self._acting: dict[int, Mask] = {}

    def _whitened(self, columns: Array) -> Array:
        white = self.rows.white(columns)
        return np.concatenate((white, np.zeros((self._known, white.shape[1]))))

    def _acts(self, k: int) -> Mask:
        """Speeds (n_v,) in whose rows a candidate acts."""
        if k not in self._acting:
            squares = np.sum(self._plain[k] ** 2, axis=(0, 2))
            self._acting[k] = np.asarray(squares > ACTS * squares.max())
        return self._acting[k]

    def columns(self, chosen: Sequence[int]) -> Array:
        """Columns (W, n_v, n + c) of the model with those chosen."""
        return np.concatenate([self._model, *(self.candidates[k].columns for k in chosen)], axis=2)

    @staticmethod
    def _key(chosen: Sequence[int], beside: Sequence[int] | None) -> Key:
        """Of what is kept for those chosen: in their order, and beside which they are held at zero, None for these."""
        return tuple(chosen), None if beside is None or set(beside) == set(chosen) else frozenset(beside)

    def solution(self, chosen: Sequence[int], beside: Sequence[int] | None = None) -> Array:
        """Parameters, coefficients and calibration (n + c + m,) of the model with those chosen; beside: see `_columns`.

        Kept until rows are whitened anew.
        """
        key = self._key(chosen, beside)
        if key not in self._solved:
            columns = self._columns(chosen, beside)
            if key not in self._solved:  # `zeroed` may have solved it for its columns
                self._solved[key] = self._fitted_to(chosen, columns, self._b)
        return self._solved[key]

    def _fitted_to(self, chosen: Sequence[int], columns: Array, b: Array) -> Array:
        """Solution (n + c + m,) of columns and b, see `bounds`."""
        return fitted(columns, b, self.bounds(chosen))

    def bounds(self, chosen: Sequence[int]) -> Mask:
        """Which unknowns (n + c + m,) a fit keeps from being negative, where rows leave more than noise.

        That draws them below zero. In other rows a value below zero within its deviation is noise.
        """
        positive = np.concatenate((self._not_negative(chosen), np.zeros(self.calibrated.count, dtype=bool)))
        return positive & bool(self.floor.any())

    def _not_negative(self, chosen: Sequence[int]) -> Mask:
        """Which unknowns (n + c,) are masses, springs, dampings or coefficients that cannot be negative."""
        own = [not self.candidates[k].traits.signed for k in chosen for _ in self.candidates[k].parameters]
        return np.array([*self._positive.tolist(), *own], dtype=bool)

    def _terms(self, chosen: Sequence[int], solution: Array) -> Array:
        """Sums of squares (n_v,) of the terms of each speed's rows, over their deviations."""
        plain = np.concatenate([self._plain_model, *(self._plain[k] for k in chosen)], axis=2)
        return np.asarray(np.sum((plain * solution[: plain.shape[2]]) ** 2, axis=(0, 2)))

    def covariance(self, chosen: Sequence[int], further: Array | None = None) -> Array:
        """Covariance of the solution (n + c, n + c) from all windows, infinite where they determine nothing.

        further (W, n_v, s): columns of unknowns beside it, which come last.
        """
        beside = np.empty((self._b.size, 0)) if further is None else self._whitened(further)
        columns = self._columns(chosen)
        known = columns.shape[1] - self.calibrated.count
        covariance = solve(np.column_stack((columns, beside, self._b))).covariance()
        wanted = np.delete(np.arange(len(covariance)), slice(known, columns.shape[1]))
        return covariance[np.ix_(wanted, wanted)]

    def residual(self, chosen: Sequence[int], solution: Array) -> Array:
        """What is left of every row (W, n_v) over its own deviation, see `reweight`."""
        plain = [self._plain_model, *(self._plain[k] for k in chosen), self._plain_calibration]
        return np.asarray(self.rows.b / self.std - np.concatenate(plain, axis=2) @ solution)
