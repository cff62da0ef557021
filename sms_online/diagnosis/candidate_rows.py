"""Rows whitened for a model and the candidates beside it: gains, solutions, predictions of held-out blocks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sms_online.diagnosis.calibrated import Calibrated
from sms_online.diagnosis.candidate import Candidate, Laws
from sms_online.diagnosis.evidence import Gain, basis, free_of, gains, least_squares, least_squares_without, together
from sms_online.diagnosis.folds import Folds
from sms_online.diagnosis.scale_free import NEAR, ScaleFree, converged, cost_of
from sms_online.diagnosis.weak_rows import WeakRows
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.stream import Array
from sms_online.trackers.factor import solve
from sms_online.trackers.interface import Prior, prior_factor

# A row is acted on where a candidate's column has at least this share of its largest row's squares.
ACTS = 0.01
# Rows whose mean square exceeds their variance by more than this although everything that is known of has been
# subtracted have an error of their own: friction is never quite its model.
LARGEST_RATIO = 1.5
# Rows for a column at least, for curves to be fitted together.
LEAST_ROWS = 4
# Share of a row's variance by which that of the effects chosen has to change for rows to be whitened anew.
SMALL_CHANGE = 0.1


_Key = tuple[tuple[int, ...], frozenset[int] | None]


class CandidateRows:
    """Rows of a session beside a model and candidates for what it lacks, whitened together.

    folds: blocks of the windows (W,) that are held out in turn.
    """

    def __init__(
        self,
        rows: WeakRows,
        candidates: Sequence[Candidate],
        folds: Folds,
        prior: Prior | None = None,
        fixed: Sequence[Candidate] = (),
        laws: Laws | None = None,
        declared: Iterable[str] = (),
        types: Iterable[Sequence[int]] | None = None,
        of_effects: Sequence[bool] | None = None,
        positive: Sequence[bool] | None = None,
        calibrated: Calibrated | None = None,
        inertial: Sequence[bool] | None = None,
    ) -> None:
        """fixed: effects of the model already, whose columns come right after its parameters'. laws: without them
        candidates determine all. declared: keys of the effects that the model has. types: speeds of each type of
        rows, each its own unless given. of_effects (n,): which of the model's parameters are coefficients of effects;
        positive (n,): which cannot be negative. calibrated: what the description may be off by, nothing by default;
        its m unknowns come last in a solution. inertial (n,): which of the model's parameters are of inertial forces.
        """
        nothing = Calibrated((), np.empty((*rows.b.shape, 0)), frozenset())
        self.calibrated, self._fixed = nothing if calibrated is None else calibrated, list(fixed)
        self.rows, self.candidates, self.folds = rows, list(candidates), folds
        self._laws, self._prior = laws, prior
        self._n, self._n_v = rows.Y.shape[2], rows.Y.shape[1]
        self._declared = frozenset(declared)
        self._types = [[speed] for speed in range(self._n_v)] if types is None else [list(each) for each in types]
        self._of_effects = [*(of_effects or [False] * self._n), *(True for each in fixed for _ in each.parameters)]
        self._positive = np.array([False] * self._n if positive is None else positive, dtype=bool)
        self._model = np.concatenate([rows.Y, *(candidate.columns for candidate in fixed)], axis=2)
        self._inertial = np.zeros(self._model.shape[2], dtype=bool)
        self._inertial[: self._n] = False if inertial is None else inertial
        # Those beside whose estimate rows without a torque count by their size, and that of the model.
        self._beside: tuple[int, ...] = ()
        self._scale_at = np.zeros(self._model.shape[2])
        if rows.weights is not None:
            self._scale_at[: self._n] = rows.weights
        self._expected = self._scale_at
        # A prior gives the scale itself.
        unknown = prior is None or not prior.known.any()
        self._scaleless = unknown and bool(self._expected.any()) and not np.all(np.any(rows.b, axis=0))
        self.trials = len(self.candidates)
        # Covariance of what the laws of the chosen effects do not determine.
        self._own = np.zeros_like(rows.std)
        self._free = np.zeros((len(rows.b), HOPS, self._n_v))
        # Speeds whose rows have no such covariance, with these effects chosen.
        self._loud: tuple[frozenset[int], NDArray[np.bool_]] = frozenset(), np.zeros(self._n_v, dtype=np.bool_)
        self._whiten()

    def reweight(self, chosen: Sequence[int], solution: Array | None = None) -> bool:
        """Whiten the rows with what the laws of the chosen effects do not determine too; whether the weights change.

        solution (n + c,): from all windows unless given.
        """
        if self._laws is None:
            return False
        own, free = np.zeros_like(self._own), np.zeros_like(self._free)
        at, solution = self._model.shape[2], self.solution(chosen) if solution is None else solution
        for k in chosen:
            c = len(self.candidates[k].parameters)
            unmodelled = self._laws.unmodelled(self.candidates[k], solution[at : at + c])
            own += unmodelled.own
            free += unmodelled.free
            at += c
        if self._loud[0] == frozenset(chosen):
            own[:, self._loud[1]], free[..., self._loud[1]] = 0.0, 0.0
        used, wanted = self._own + self._free[:, 0], own + free[:, 0]
        moved = tuple(chosen) != self._beside
        self._beside = tuple(chosen)
        if not np.any(np.abs(wanted - used) > SMALL_CHANGE * (self.rows.std**2 + used)):
            if moved and self.freed:
                self._whiten()
            return False
        self._own, self._free = own, free
        self._whiten()
        # Rows that leave more than noise even so are uncertain by that: what the laws do not determine there would grow
        # with their coefficients, and these with it.
        loud = (self.floor > 0.0) & np.any(wanted, axis=0)
        if np.any(loud):
            own[:, loud], free[..., loud] = 0.0, 0.0
            self._loud = frozenset(chosen), loud
            self._whiten()
        return True

    def _whiten(self) -> None:
        """Whiten the rows with what the laws of the effects of the last `reweight` do not determine."""
        rows = self.rows
        self._forget()
        self.std = np.sqrt(rows.std**2 + self._own + self._free[:, 0])
        self._plain_model = self._model / self.std[..., None]
        self._plain_calibration = self.calibrated.columns / self.std[..., None]
        self._plain = [candidate.columns / self.std[..., None] for candidate in self.candidates]
        self.floor, lacking = self._floor()
        # Where everything together leaves noise, a held-out row counts by its own deviation; where much more, as does
        # every other of its coordinate: relative to the torque then.
        self._scale = np.sqrt(self.std**2 + lacking)
        # Windows that overlap share the noise of the effects chosen: as errors of their own they count it once.
        own = self.floor * self.std**2 + HOPS * self._own
        rows.whiten(own, self._free if np.any(self._free) else None)
        # What is known beforehand are rows too: of parameters, and below them of calibration.
        known = prior_factor(self._prior, self._n)
        n, width, first = self._n, self._model.shape[2], self.rows.b.size
        near = width if self.freed else 0
        self._known = len(known) + near + self.calibrated.count
        candidates = (candidate.columns for candidate in self.candidates)
        parts = [self._model, rows.b[..., None], self.calibrated.columns, *candidates]
        white = self._whitened(np.concatenate(parts, axis=2))
        white[first : first + len(known), :n], white[first : first + len(known), width] = known[:, :-1], known[:, -1]
        ends = np.cumsum([part.shape[2] for part in parts])
        self._white, b, self._N, *self._Z = np.split(white, ends[:-1], axis=1)
        self._white_b = b[:, 0]
        self._linearise()

    def _linearise(self) -> None:
        """Have rows without a torque that leave more than noise count by their size, about the estimate beside those of
        the last `reweight`: see `scale_free`."""
        self._forget()
        self._Y, self._b = self._white, self._white_b
        if not self.freed:
            return
        shape, size, n = (-1, self._n_v), self.rows.b.size, self._model.shape[2]
        speeds = np.flatnonzero(self._homogeneous).tolist()
        free = ScaleFree(self._white[:size].reshape(*shape, n), speeds, self._inertial)
        rest = [*(self._Z[k] for k in self._beside), self._N]

        def about(solution: Array) -> Array:
            left = self._white_b - np.concatenate([self._white, *rest], axis=1) @ solution
            Y, added = free.about(solution[:n], left[:size].reshape(shape))
            self._forget()
            self._Y = np.concatenate((Y.reshape(size, n), self._white[size:]))
            self._b = self._white_b.copy()
            self._b[:size] += added.ravel()
            return self.solution(self._beside)

        near = slice(size + self._known - self.calibrated.count - n, size + self._known - self.calibrated.count)
        lengths = NEAR * np.linalg.norm(self._white[:size], axis=0)
        self._white[near], self._white_b[near] = np.diag(lengths), lengths * self._expected
        start = np.zeros(n + sum(each.shape[1] for each in rest))
        start[:n] = self._scale_at

        def cost(solution: Array) -> float:
            left = (self._white_b - np.concatenate([self._white, *rest], axis=1) @ solution)[:size].reshape(shape)
            off = lengths * (solution[:n] - self._expected)
            return cost_of(free.squares(solution[:n], left, self._scale_at), off, len(left))

        about(converged(about, start, cost))
        self._forget()

    def _floor(self) -> tuple[Array, Array]:
        """What all candidates together leave of each speed's rows beyond their variance, (n_v,).

        As a share of that variance, and as a mean square; zero where it is little. Rows that leave more and hold no
        torque are homogeneous in π: what makes π small makes their residual small, which counts beside their terms.
        """
        left = self.rows.b / self.std
        every = np.concatenate([self._plain_model, *self._plain, self._plain_calibration], axis=2)
        laws = (p for p, each in zip(self._plain, self.candidates, strict=True) if not each.traits.learned)
        # All curves at once would leave little of few rows, whatever these hold.
        enough = LEAST_ROWS * every.shape[2] <= left.size
        plain = every if enough else np.concatenate([self._plain_model, *laws, self._plain_calibration], axis=2)
        solution = together(plain, left, self._prior)
        ratio = np.mean((left - plain @ solution) ** 2, axis=0)
        beyond = ratio > LARGEST_RATIO
        if beyond.any() and self._scaleless:
            # All candidates mimic the model's terms, which then say nothing of a scale; those found so far do not.
            solution, ratio, sized = self._scale_free(left)
            beyond = sized > LARGEST_RATIO
        lacking = np.maximum(0.0, (ratio - 1.0) * np.mean(self.std**2, axis=0))
        self._homogeneous = beyond & ~np.any(self.rows.b, axis=0)
        self._usual = self._terms([], solution)
        return np.where(beyond, ratio - 1.0, 0.0), np.where(beyond, lacking, 0.0)

    def _scale_free(self, b: Array) -> tuple[Array, Array, Array]:
        """Solution beside those of the last `reweight`, and mean squares (n_v,) that it leaves of rows b (W, n_v).

        Each type of rows counts by what it leaves, those without a torque by their size. Last, mean squares with these
        as large as the parameters behind the weights make them.
        """
        beside = np.concatenate([np.empty((*b.shape, 0)), *(self._plain[k] for k in self._beside)], axis=2)
        speeds = np.flatnonzero(~np.any(self.rows.b, axis=0)).tolist()
        free, n = ScaleFree(self._plain_model, speeds, self._inertial), self._model.shape[2]
        solution = free.solved(beside, b, self._scale_at, self._expected, 1.0)
        self._scale_at = solution[:n]
        left = b - np.concatenate((self._plain_model, beside), axis=2) @ solution
        return solution, np.mean(left**2, axis=0), free.squares(solution[:n], left, self._expected)

    @property
    def freed(self) -> bool:
        """Whether rows without a torque leave more than noise whatever is added, and count by their size."""
        return self._scaleless and bool(np.any(self._homogeneous))

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

    def _with_calibration(self, chosen: Sequence[int], held: NDArray[np.bool_]) -> Array:
        self._N[-held.size :] = self.calibrated.information(held)
        return np.concatenate([self._Y, *(self._Z[k] for k in chosen), self._N], axis=1)

    def zeroed(self, chosen: Sequence[int]) -> NDArray[np.bool_]:
        """Which numbers of calibration (m,) are held at zero beside those chosen: effects replace them, or have to."""
        m, key = self.calibrated.count, frozenset(chosen)
        if key not in self._zeroed:
            solution = None
            effects = (candidate.effect for candidate in (*self._fixed, *(self.candidates[k] for k in chosen)))
            held = self.calibrated.said_by(effects)
            while m:
                solution = least_squares(self._with_calibration(chosen, held), self._b)
                beyond = self.calibrated.beyond(solution[-m:]) & ~held
                if not beyond.any():
                    break
                held = held | beyond
            self._zeroed[key] = held
            if solution is not None:
                self._solved[tuple(chosen), None] = solution
        return self._zeroed[key]

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
            Q = basis(self._columns(chosen))
            self._bases[key] = Q, free_of(Q, self._b[:, None])[:, 0]
        return self._bases[key]

    def _plausible(self, candidate: Candidate, found: Gain) -> Gain:
        """The gain, none where the effect cannot have the coefficients."""
        possible = candidate.traits.plausible(found.coefficients, self.rows.sample_rate)
        return found if possible else replace(found, gain=0.0)

    def gain_of(self, candidate: Candidate, chosen: Sequence[int]) -> Gain:
        """What any candidate would take beside those chosen."""
        return self._plausible(candidate, gains(*self.left(chosen), [self._whitened(candidate.columns)])[0])

    def put(self, k: int, candidate: Candidate) -> None:
        """Put another form of an effect in the place of a candidate."""
        self.candidates[k] = candidate
        self._plain[k] = candidate.columns / self.std[..., None]
        self._Z[k] = self._whitened(candidate.columns)
        self._forget()

    def _forget(self) -> None:
        """What was solved with other weights or columns."""
        self._zeroed: dict[frozenset[int], NDArray[np.bool_]] = {}
        self._solved: dict[_Key, Array] = {}
        self._held_out: dict[_Key, Array] = {}
        self._fitted: dict[_Key, Array] = {}
        self._bases: dict[tuple[int, ...], tuple[Array, Array]] = {}
        self._gains: dict[tuple[int, ...], list[Gain]] = {}
        self._acting: dict[int, NDArray[np.bool_]] = {}

    def _whitened(self, columns: Array) -> Array:
        white = self.rows.white(columns)
        return np.concatenate((white, np.zeros((self._known, white.shape[1]))))

    def _acts(self, k: int) -> NDArray[np.bool_]:
        """Speeds (n_v,) in whose rows a candidate acts."""
        if k not in self._acting:
            squares = np.sum(self._plain[k] ** 2, axis=(0, 2))
            self._acting[k] = np.asarray(squares > ACTS * squares.max())
        return self._acting[k]

    def columns(self, chosen: Sequence[int]) -> Array:
        """Columns (W, n_v, n + c) of the model with those chosen."""
        return np.concatenate([self._model, *(self.candidates[k].columns for k in chosen)], axis=2)

    @staticmethod
    def _key(chosen: Sequence[int], beside: Sequence[int] | None) -> _Key:
        """Of what is kept for those chosen: in their order, and beside which they are held at zero, None for these."""
        return tuple(chosen), None if beside is None or set(beside) == set(chosen) else frozenset(beside)

    def solution(self, chosen: Sequence[int], beside: Sequence[int] | None = None) -> Array:
        """Parameters, coefficients and calibration (n + c + m,) of the model with those chosen; beside: see `_columns`.

        Kept until rows are whitened anew.
        """
        key = self._key(chosen, beside)
        if key not in self._solved:
            self._solved[key] = least_squares(self._columns(chosen, beside), self._b)
        return self._solved[key]

    def solutions(self, chosen: Sequence[int], beside: Sequence[int] | None = None) -> Array:
        """The same without each part of the windows in turn, (parts, n + c + m)."""
        known = np.zeros(len(self._b) - self.rows.b.size, dtype=bool)
        left_out = [
            np.concatenate((np.repeat(~self.folds.fitted(k), self._n_v), known)) for k in range(self.folds.parts)
        ]
        return least_squares_without(self._columns(chosen, beside), self._b, left_out)

    def predicted(
        self, chosen: Sequence[int], solutions: Array | None = None, beside: Sequence[int] | None = None
    ) -> Array:
        """What is left of every row (W, n_v) over its own deviation, blocks predicted from the others."""
        solutions = self.solutions(chosen, beside) if solutions is None else solutions
        left = self.residual(chosen, self.solution(chosen, beside=beside))
        for k, solution in enumerate(solutions):
            held = self.folds.predicted(k)
            left[held] = self.residual(chosen, solution)[held]
        return left

    def _sized(self, chosen: Sequence[int], solution: Array) -> Array:
        """What is left (W, n_v), rows without a torque that leave more than noise as if they had their usual size."""
        left = self.residual(chosen, solution)
        if np.any(self._homogeneous):
            terms = self._terms(chosen, solution)
            sized = self._homogeneous & (terms > 0.0)
            left[:, sized] *= np.sqrt(self._usual[sized] / terms[sized])
        return left

    def held_out(self, chosen: Sequence[int], beside: Sequence[int] | None = None) -> Array:
        """Sums of squares of held-out rows by block and speed, (B, n_v), relative where they leave more than noise.

        Kept as solutions are: every candidate beside the same others asks for those of the others.
        """
        key = self._key(chosen, beside)
        if key not in self._held_out:
            left = self._sized(chosen, self.solution(chosen, beside))
            for k, solution in enumerate(self.solutions(chosen, beside)):
                held = self.folds.predicted(k)
                left[held] = self._sized(chosen, solution)[held]
            self._held_out[key] = self._by_block(left)
        return self._held_out[key]

    def fitted(self, chosen: Sequence[int], beside: Sequence[int] | None = None) -> Array:
        """The same sums of the fit to all rows."""
        key = self._key(chosen, beside)
        if key not in self._fitted:
            self._fitted[key] = self._by_block(self._sized(chosen, self.solution(chosen, beside)))
        return self._fitted[key]

    def _terms(self, chosen: Sequence[int], solution: Array) -> Array:
        """Sums of squares (n_v,) of the terms of each speed's rows, over their deviations."""
        plain = np.concatenate([self._plain_model, *(self._plain[k] for k in chosen)], axis=2)
        return np.asarray(np.sum((plain * solution[: plain.shape[2]]) ** 2, axis=(0, 2)))

    def _by_block(self, left: Array) -> Array:
        squares = (left * self.std / self._scale) ** 2
        return np.array([squares[self.folds.held(k)].sum(axis=0) for k in range(self.folds.count)])

    def spread(self, chosen: Sequence[int]) -> Array:
        """Deviations (n + c,) of the solution by the jackknife over the parts, whatever rows hold beside noise."""
        solutions = self.solutions(chosen)
        n = len(solutions)
        squares = np.sum((solutions - solutions.mean(axis=0)) ** 2, axis=0)
        return np.asarray(np.sqrt((n - 1) / n * squares))[: squares.size - self.calibrated.count]

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
