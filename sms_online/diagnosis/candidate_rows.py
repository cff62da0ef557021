"""Rows whitened for a model and the candidates chosen beside it, whose coefficients are in the rows' weights."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from sms_online.calibration.multiplied_noise import shares
from sms_online.diagnosis.calibrated import Calibrated
from sms_online.diagnosis.candidate import Candidate, Laws
from sms_online.diagnosis.candidate_fits import CandidateFits
from sms_online.diagnosis.evidence import least_squares, together
from sms_online.diagnosis.folds import Folds
from sms_online.diagnosis.scale_free import Scale
from sms_online.diagnosis.weak_rows import WeakRows
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.stream import Array, Mask
from sms_online.trackers.interface import Prior, prior_factor

# Rows whose mean square exceeds their variance by more than this although everything that is known of has been
# subtracted have an error of their own: friction is never quite its model.
LARGEST_RATIO = 1.5
# They exceed it by little where each type leaves less than this times its variance beyond it.
LITTLE_MORE = 15.0
# With variance that is yet to be added they clearly do where so many times as much would be left.
CLEARLY = 4.0
# Where they do not, and this share of what is beyond noise without the candidates is left with all of them, what is
# left is that weights are of parameters without them.
ROUGHLY = 0.03
# Rows for a column at least, for curves to be fitted together.
LEAST_ROWS = 4
# Times at most that rows are whitened anew for a set of effects: weights follow coefficients, and these the weights.
ROUNDS = 3
# Share of a row's variance by which that of the effects chosen has to change for rows to be whitened anew.
SMALL_CHANGE = 0.1


class CandidateRows(CandidateFits):
    """Rows of a session beside a model and candidates for what it lacks, whitened together.

    folds: blocks of the windows (W,) that are held out in turn. whitenings: how often rows were whitened so far, which
    takes most of a search's time.
    """

    whitenings = 0

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
        super().__init__(rows, candidates, fixed, positive, calibrated)
        self.folds, self._laws, self._prior = folds, laws, prior
        self._declared = frozenset(declared)
        self._types = [[speed] for speed in range(self._n_v)] if types is None else [list(each) for each in types]
        self._of_effects = [*(of_effects or [False] * self._n), *(True for each in fixed for _ in each.parameters)]
        expected = np.zeros(self._model.shape[2])
        if rows.weights is not None:
            expected[: self._n] = rows.weights
        is_inertial = np.zeros(self._model.shape[2], dtype=bool)
        is_inertial[: self._n] = False if inertial is None else inertial
        known = prior is not None and bool(prior.known.any())
        self._scale = Scale(rows.b, expected, is_inertial, known)
        self.trials = len(self.candidates)
        self._begin()

    def _begin(self) -> None:
        """Whiten the rows for none of the candidates, whatever they were whitened for before."""
        rows = self.rows
        # Those beside whose estimate rows without a torque count by their size.
        self._beside: tuple[int, ...] = ()
        # Covariance of what the laws of the chosen effects do not determine.
        self._own, self._free = np.zeros_like(rows.std), np.zeros((len(rows.b), HOPS, self._n_v))
        # Speeds whose rows have no such covariance, with these effects chosen.
        self._exceeding: tuple[frozenset[int], Mask] = frozenset(), np.zeros(self._n_v, dtype=np.bool_)
        # Mean square that everything together left of the rows, and with which deviations.
        self._explained = 0.0, rows.std
        self._scale.begin()
        self._whiten()
        self._weighed: tuple[int, ...] | None = ()  # what rows are whitened for from the beginning on, if so

    def weigh(self, chosen: Sequence[int]) -> None:
        """Whiten the rows for those chosen from the beginning, until the weights are those of their coefficients.

        So they follow from the rows and those chosen alone, and not from what was asked before.
        """
        if self._weighed == tuple(chosen):
            self._beside = tuple(chosen)
            return
        if self._weighed != ():
            self._begin()
        self._iterated(chosen)
        self._weighed = tuple(chosen)

    def _iterated(self, chosen: Sequence[int]) -> None:
        """Reweight the rows for those chosen until the weights are those of their coefficients."""
        for _ in range(ROUNDS):
            if not self.reweight(chosen):
                break

    def reweight(self, chosen: Sequence[int], solution: Array | None = None) -> bool:
        """Whiten the rows with what the laws of the chosen effects do not determine too; whether the weights change.

        solution (n + c,): from all windows unless given.
        """
        if self._laws is None:
            return False
        own, free = self._unmodelled(self._laws, chosen, solution)
        if self._exceeding[0] == frozenset(chosen):
            own[:, self._exceeding[1]], free[..., self._exceeding[1]] = 0.0, 0.0
        used, wanted = self._own + self._free[:, 0], own + free[:, 0]
        moved = tuple(chosen) != self._beside
        self._beside = tuple(chosen)
        if not np.any(np.abs(wanted - used) > SMALL_CHANGE * (self.rows.std**2 + used)):
            if moved and self._scale.freed:
                self._weighed = None
                self._whiten()
            return False
        self._weighed = None
        self._own, self._free = own, free
        self._whiten()
        # Rows that leave more than noise even so are uncertain by that: what the laws do not determine there would grow
        # with their coefficients, and these with it. Not so by little more, as noise of torques that has a memory does.
        exceeding = (self.floor > 0.0) & np.any(wanted, axis=0)
        if np.any(exceeding) and self._by_much:
            own[:, exceeding], free[..., exceeding] = 0.0, 0.0
            self._exceeding = frozenset(chosen), exceeding
            self._whiten()
        return True

    def _unmodelled(self, laws: Laws, chosen: Sequence[int], solution: Array | None = None) -> tuple[Array, Array]:
        """Covariances (W, n_v) and (W, HOPS, n_v) of what the laws of the chosen effects do not determine."""
        own, free = np.zeros_like(self._own), np.zeros_like(self._free)
        at, solution = self._model.shape[2], self.solution(chosen) if solution is None else solution
        for k in chosen:
            c = len(self.candidates[k].parameters)
            unmodelled = laws.unmodelled(self.candidates[k], solution[at : at + c])
            own += unmodelled.own
            free += unmodelled.free
            at += c
        return own, free

    def stays_exceeding(self, chosen: Sequence[int], k: int) -> bool:
        """Whether rows that a candidate acts on clearly leave more than noise with those chosen, this one last.

        By what everything together leaves of them with the variance that they would have then, see `_floor`.
        """
        acts = self._acts(k)
        if self._laws is None or not self.floor[acts].any():
            return False
        own, free = self._unmodelled(self._laws, chosen)
        std = np.sqrt(self.rows.std**2 + own + free[:, 0])
        squares = self._beside_fit(chosen, std)[2] if self.exceeds else np.mean(self._together(std)[1] ** 2, axis=0)
        return bool(np.any(squares[acts] > CLEARLY * LARGEST_RATIO))

    def _whiten(self) -> None:
        """Whiten the rows with what the laws of the effects of the last `reweight` do not determine."""
        rows = self.rows
        self.whitenings += 1
        self._forget()
        self.std = np.sqrt(rows.std**2 + self._own + self._free[:, 0])
        self._plain_model = self._model / self.std[..., None]
        self._plain_calibration = self.calibrated.columns / self.std[..., None]
        self._plain = [candidate.columns / self.std[..., None] for candidate in self.candidates]
        self.floor, lacking = self._floor()
        # Where everything together leaves noise, a held-out row counts by its own deviation; where much more, as does
        # every other of its coordinate: relative to the torque then.
        self._counted = np.sqrt(self.std**2 + lacking)
        # Windows that overlap share the noise of the effects chosen: as errors of their own they count it once.
        own = self.floor * self.std**2 + HOPS * self._own
        rows.whiten(own, self._free if np.any(self._free) else None)
        # What is known beforehand are rows too: of parameters, and below them of calibration.
        known = prior_factor(self._prior, self._n)
        n, width, first = self._n, self._model.shape[2], self.rows.b.size
        near = width if self._scale.freed else 0
        self._known = len(known) + near + self.calibrated.count
        candidates = (candidate.columns for candidate in self.candidates)
        samples = self.calibrated.synthetic.reshape(*rows.b.shape, -1)
        parts = [self._model, rows.b[..., None], self.calibrated.columns, samples, *candidates]
        white = self._whitened(np.concatenate(parts, axis=2))
        white[first : first + len(known), :n], white[first : first + len(known), width] = known[:, :-1], known[:, -1]
        ends = np.cumsum([part.shape[2] for part in parts])
        self._white, b, self._N, synthetic, *self._Z = np.split(white, ends[:-1], axis=1)
        self._white_b = b[:, 0]
        self._take_off_noise(synthetic[:first].reshape(self.calibrated.synthetic.shape))
        self._linearise()

    def _take_off_noise(self, synthetic: Array) -> None:
        """Take off columns of gains what rows say of the noise that they multiply, see `multiplied_noise`.

        synthetic (W, n_v, ·, SAMPLES): whitened rows of such noise.
        """
        size, multiplied = self.rows.b.size, self.calibrated.multiplied
        gained = [
            (k, self._N[:size, each.column], -1.0) for k, each in enumerate(multiplied) if each.column is not None
        ]
        for candidate, columns in zip(self.candidates, self._Z, strict=True):
            if candidate.is_gain:
                # It multiplies what acts, not what is read.
                own = (k for k, each in enumerate(multiplied) if candidate.effect.where in each.places)
                gained += [(k, columns[:size, 0], 1.0) for k in own]
        if not gained:
            return
        beside = np.concatenate([self._white, *(self._Z[k] for k in self._beside), self._N], axis=1)
        m = self.calibrated.count
        beside[len(beside) - m :, beside.shape[1] - m :] = self.calibrated.information(np.zeros(m, dtype=np.bool_))
        residual = (self._white_b - beside @ least_squares(beside, self._white_b))[:size].reshape(self.rows.b.shape)
        of_noise = shares(synthetic, np.sum(residual**2, axis=0), len(synthetic))
        expected = (of_noise * residual[:, :, None]).reshape(size, -1)
        for k, column, sign in gained:
            column += sign * expected[:, k]

    def _linearise(self) -> None:
        """Have rows without a torque that are freed count by their size, about the estimate beside those of the last
        `reweight`: see `scale_free`."""
        self._forget()
        self._Y, self._b = self._white, self._white_b
        if not self._scale.freed:
            return
        size, n = self.rows.b.size, self._model.shape[2]
        shape, end = (len(self.rows.b), self._n_v, -1), size + self._known - self.calibrated.count
        self._white[end - n : end], self._white_b[end - n : end] = self._scale.near(self._white[:size])

        rest = np.concatenate([*(self._Z[k] for k in self._beside), self._N], axis=1)
        white, b, beside = (part[:size].reshape(shape) for part in (self._white, self._white_b, rest))
        # From one point to the next only rows that are freed change: all others are reduced once.
        freed = np.isin(np.arange(self._n_v), self._scale.freed)
        others = np.concatenate([part[:, ~freed] for part in (white, beside, b)], axis=2)
        known = np.column_stack((self._white, rest, self._white_b))[size : self._b.size - self.calibrated.count]
        reduced = np.linalg.qr(np.concatenate((others.reshape(-1, known.shape[1]), known)), mode="r")

        def solve(Y: Array, b: Array) -> Array:
            self._Y = np.concatenate((Y.reshape(size, n), self._white[size:]))
            self._b = np.concatenate((b.ravel(), self._white_b[size:]))
            moved = np.concatenate((Y[:, freed], beside[:, freed], b[:, freed, None]), axis=2)
            return self._released(self._beside, np.concatenate((reduced, moved.reshape(-1, known.shape[1]))))[1]

        self._scale.linearise(white, b[..., 0], beside, solve)
        self._forget()

    def _floor(self) -> tuple[Array, Array]:
        """What all candidates together leave of each speed's rows beyond their variance, (n_v,).

        As a share of that variance, and as a mean square; zero where it is little. Rows that leave more and hold no
        torque are homogeneous in π: what makes π small makes their residual small, which counts beside their terms.
        """
        solution, ratio = np.zeros(self.n_model), np.full(self._n_v, np.inf)
        if not (self._scale.unknown and self._surely_more()):
            solution, left = self._together(self.std)
            ratio = np.mean(left**2, axis=0)
            self._explained = float(ratio.mean()), self.std
        beyond = ratio > LARGEST_RATIO
        if beyond.any() and self._scale.unknown:
            # All candidates mimic the model's terms, which then say nothing of a scale; those found so far do not.
            beside, left, sized = self._beside_fit(self._beside, self.std)
            if not np.any(beyond & ~self._scale.homogeneous) and _only_rough_weights(ratio, left):
                # Torques at noise fix the scale.
                beyond = np.zeros_like(beyond)
            else:
                solution, ratio, beyond = beside, left, sized > LARGEST_RATIO
                self._scale.at = solution[: self.n_model]
        lacking = np.maximum(0.0, (ratio - 1.0) * np.mean(self.std**2, axis=0))
        self._homogeneous = beyond & self._scale.homogeneous
        # Beside torques that leave more than noise their scale is as weak, and that of their noise draws it.
        self._scale.free(bool(beyond.any()), self._model @ self._scale.expected / self.std)
        self._usual = self._terms([], solution)
        # Rows that are beyond it by their size may leave less than it with parameters that are too small.
        return np.where(beyond, np.maximum(0.0, ratio - 1.0), 0.0), np.where(beyond, lacking, 0.0)

    def _beside_fit(self, chosen: Sequence[int], std: Array) -> tuple[Array, Array, Array]:
        """What the criterion free of scale makes of rows of deviations (W, n_v) with those chosen, see `Scale.fit`."""
        beside = self.columns(chosen)[..., self.n_model :] / std[..., None]
        return self._scale.fit(self._model / std[..., None], beside, self.rows.b / std, self._not_negative(chosen))

    def _surely_more(self) -> bool:
        """Whether rows clearly leave more than noise whatever is added: with these deviations what they left with those
        of the last fit of everything together can have fallen by their largest growth alone."""
        least, std = self._explained
        return bool(least * np.min((std / self.std) ** 2) > CLEARLY * LARGEST_RATIO)

    def _together(self, std: Array) -> tuple[Array, Array]:
        """Solution of the model with all candidates, and what that leaves of every row over its deviation (W, n_v)."""
        plain, b = [self._model, *(c.columns for c in self.candidates), self.calibrated.columns], self.rows.b / std
        # All curves at once would leave little of few rows, whatever these hold.
        if LEAST_ROWS * sum(part.shape[2] for part in plain) > b.size:
            laws = (c.columns for c in self.candidates if not c.traits.learned)
            plain = [self._model, *laws, self.calibrated.columns]
        columns = np.concatenate(plain, axis=2) / std[..., None]
        solution = together(columns, b, self._prior)
        return solution, b - columns @ solution

    @property
    def exceeds(self) -> bool:
        """Whether rows leave more than noise whatever is added, so that those without a torque count by their size."""
        return self._scale.exceeds

    @property
    def exceeds_by_much(self) -> bool:
        """Whether they leave far more, so that nothing says at which scale a fit that counts noise alone ends."""
        return self.exceeds and self._by_much

    @property
    def _by_much(self) -> bool:
        return bool(self.floor.max() > LITTLE_MORE)

    def put(self, k: int, candidate: Candidate) -> None:
        """Put another form of an effect in the place of a candidate."""
        self.candidates[k] = candidate
        self._weighed = None
        self._plain[k] = candidate.columns / self.std[..., None]
        self._Z[k] = self._whitened(candidate.columns)
        self._forget()


def _only_rough_weights(left: Array, before: Array) -> bool:
    """Whether rough weights alone may be why all candidates leave mean squares of rows (n_v,) beyond noise.

    before (n_v,): left by those chosen alone.
    """
    excess, whole = (float(np.sum(np.maximum(0.0, each - 1.0))) for each in (left, before))
    return bool(np.all(left <= CLEARLY * LARGEST_RATIO)) and excess < ROUGHLY * whole
