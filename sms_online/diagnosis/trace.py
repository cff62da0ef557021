"""From a residual to the effects behind it: greedy selection, checked on held-out rows, with honest doubt.

Candidates compete for what the model leaves of the whitened rows. The best is taken where its gain is no accident among
all that were tried and where it also lowers the residual of windows that it was not fitted to, or where it is friction
that holds its axis and makes them likelier; then the rest compete for what is left. A candidate that takes nearly as
much as the one taken is named beside it as indistinguishable.
Source of the selection: Pati, Rezaiifar and Krishnaprasad, Asilomar Conf. Signals, Systems and Computers (1993) 40
(orthogonal matching pursuit); of the correction for many candidates: Bonferroni's inequality.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sms_online.diagnosis.candidate import Candidate, Finding, Laws, Ranked
from sms_online.diagnosis.evidence import Gain, basis, free_of, gain, least_squares, threshold, together
from sms_online.diagnosis.weak_rows import WeakRows
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.stream import Array
from sms_online.trackers.factor import solve
from sms_online.trackers.interface import Prior, prior_factor

# Probability that a session without any effect beyond the model shows one.
FALSE_ALARM = 0.01
# An effect must lower the rms of the held-out rows that it acts on by this share.
LEAST_IMPROVEMENT = 0.05
# Candidates whose columns differ by less than 10°, sin² = 0.03 of the gain, are not told apart; nor are those whose
# likelihoods differ by less than a factor of e^5.
SAME_SHARE = 0.03
DECISIVE = 10.0
# A row is acted on where a candidate's column has at least this share of its largest row's squares.
ACTS = 0.01
# Rows whose mean square exceeds their variance by more than this although everything that is known of has been
# subtracted have an error of their own: friction is never quite its model.
LARGEST_RATIO = 1.5
# Share of a row's variance by which that of the effects chosen has to change for rows to be weighed anew.
SMALL_CHANGE = 0.1
# Dry friction is told by what it leaves open where its axis stands still for at least this share of a session.
MUCH_REST = 0.05
# Laws of it that are compared, with their shape constants, those that explain most.
RIVALS = 3
# Times at most that rows are weighed anew for a set of effects: weights follow coefficients, and these the weights.
ROUNDS = 3
# At most so many effects are looked for in turn.
MOST_EFFECTS = 8


class Tracing:
    """Searches the candidates for what the rows of a session leave.

    fitted (W,): windows that coefficients are fitted to; the others check them.
    """

    def __init__(
        self,
        rows: WeakRows,
        candidates: Sequence[Candidate],
        fitted: NDArray[np.bool_],
        prior: Prior | None = None,
        fixed: Sequence[Candidate] = (),
        laws: Laws | None = None,
        declared: Iterable[str] = (),
    ) -> None:
        """fixed: effects of the model already, whose columns come right after its parameters'. laws: without them
        candidates leave nothing open. declared: keys of the effects that the model has.
        """
        self.rows, self.candidates, self.fitted = rows, list(candidates), fitted
        self._laws, self._prior = laws, prior
        self._n, self._n_v = rows.Y.shape[2], rows.Y.shape[1]
        self._declared = frozenset(declared)
        self._model = np.concatenate([rows.Y, *(candidate.columns for candidate in fixed)], axis=2)
        self.trials = len(self.candidates)
        # Which candidate each step of the search took, and all that were chosen then.
        self.path: list[tuple[int, list[int]]] = []
        # What the effects chosen leave open.
        self._own = np.zeros_like(rows.std)
        self._free = np.zeros((len(rows.b), HOPS, self._n_v))
        self._taken: dict[int, float] = {}  # gains of the effects chosen
        self.weigh()

    def settle(self, chosen: Sequence[int]) -> bool:
        """Weigh the rows with what the laws of the effects chosen leave open too; whether that changes the weights."""
        if self._laws is None:
            return False
        own, free = np.zeros_like(self._own), np.zeros_like(self._free)
        at, solution = self._model.shape[2], self.solution(chosen, np.ones(self.rows.count, dtype=bool))
        for k in chosen:
            c = len(self.candidates[k].parameters)
            told = self._laws.left_open(self.candidates[k], solution[at : at + c])
            own += told.own
            free += told.free
            at += c
        used, wanted = self._own + self._free[:, 0], own + free[:, 0]
        if not np.any(np.abs(wanted - used) > SMALL_CHANGE * (self.rows.std**2 + used)):
            return False
        self._own, self._free = own, free
        self.weigh()
        return True

    def weigh(self) -> None:
        """Weigh the rows, and whiten them, with what is left open by the effects settled last."""
        rows = self.rows
        self.std = np.sqrt(rows.std**2 + self._own + self._free[:, 0])
        self._plain_model = self._model / self.std[..., None]
        self._plain = [candidate.columns / self.std[..., None] for candidate in self.candidates]
        self.floor = self._floor()
        # Windows that overlap share the noise of the effects chosen: as errors of their own they count it once.
        own = self.floor * self.std**2 + HOPS * self._own
        rows.whiten(own, self._free if np.any(self._free) else None)
        # What is known beforehand are rows too, of parameters alone.
        known = prior_factor(self._prior, self._n)
        self._known = len(known)
        n, width = self._n, self._model.shape[2]
        parts = [self._model, rows.b[..., None], *(candidate.columns for candidate in self.candidates)]
        white = self._whitened(np.concatenate(parts, axis=2))
        if self._known:
            white[-self._known :, :n], white[-self._known :, width] = known[:, :-1], known[:, -1]
        ends = np.cumsum([part.shape[2] for part in parts])
        self._Y, b, *self._Z = np.split(white, ends[:-1], axis=1)
        self._b = b[:, 0]

    def _floor(self) -> Array:
        """Excess of each speed's rows over their variance, (n_v,), that all candidates together leave."""
        left = self.rows.b / self.std
        plain = np.concatenate([self._plain_model, *self._plain], axis=2)
        left = left - plain @ together(plain, left, self._prior)
        ratio = np.mean(left**2, axis=0)
        return np.where(ratio > LARGEST_RATIO, ratio - 1.0, 0.0)

    def _columns(self, chosen: Sequence[int]) -> Array:
        return np.concatenate([self._Y, *(self._Z[k] for k in chosen)], axis=1)

    def gains(self, chosen: Sequence[int]) -> list[Gain]:
        """What each candidate would take beside those chosen."""
        Q = basis(self._columns(chosen))
        r = free_of(Q, self._b[:, None])[:, 0]
        return [self._plausible(c, gain(Q, r, Z)) for c, Z in zip(self.candidates, self._Z, strict=True)]

    def _plausible(self, candidate: Candidate, found: Gain) -> Gain:
        """The gain, none where the effect cannot have the coefficients."""
        possible = candidate.traits.plausible(found.coefficients, self.rows.sample_rate)
        return found if possible else replace(found, gain=0.0)

    def gain_of(self, candidate: Candidate, chosen: Sequence[int]) -> Gain:
        """What any candidate would take beside those chosen."""
        Q = basis(self._columns(chosen))
        r = free_of(Q, self._b[:, None])[:, 0]
        return self._plausible(candidate, gain(Q, r, self._whitened(candidate.columns)))

    def put(self, k: int, candidate: Candidate) -> None:
        """Put another form of an effect in the place of a candidate."""
        self.candidates[k] = candidate
        self._plain[k] = candidate.columns / self.std[..., None]
        self._Z[k] = self._whitened(candidate.columns)

    def _whitened(self, columns: Array) -> Array:
        white = self.rows.white(columns)
        return np.concatenate((white, np.zeros((self._known, white.shape[1]))))

    def _excess(self, k: int, g: Gain) -> float:
        """Gain beyond what an absent candidate reaches, and beyond what the laws of those found are uncertain by."""
        acts = self._acts(k)
        limit = threshold(FALSE_ALARM, self.trials, self._Z[k].shape[1])
        for other, taken in self._taken.items():
            if other != k and np.any(acts & self._acts(other)):
                limit = max(limit, self.candidates[other].traits.inexact * taken)
        return g.gain - limit

    def _acts(self, k: int) -> NDArray[np.bool_]:
        """Speeds (n_v,) in whose rows a candidate acts."""
        squares = np.sum(self._plain[k] ** 2, axis=(0, 2))
        return np.asarray(squares > ACTS * squares.max())

    def _preferred(self, gains: Sequence[Gain], allowed: Sequence[int]) -> int | None:
        """The candidate to take: the best one, or one with fewer constants that takes nearly as much."""
        excess = {k: self._excess(k, gains[k]) for k in allowed}
        if not excess or max(excess.values()) <= 0.0:
            return None
        best = max(allowed, key=lambda k: excess[k])
        near = [k for k in allowed if excess[k] > 0.0 and self._near(gains[k].gain, gains[best].gain)]
        return min(near, key=lambda k: (self._constants(k), -gains[k].gain))

    @staticmethod
    def _near(one: float, best: float) -> bool:
        return one >= best - max(DECISIVE, SAME_SHARE * best)

    def _constants(self, k: int) -> int:
        candidate = self.candidates[k]
        return max(len(candidate.parameters), len(candidate.effect.coefficients))

    def run(self, refine: Callable[[Sequence[int], int], None]) -> list[int]:
        """Numbers of the candidates found, in the order of what they explain.

        refine: improves the shape constants of one of those chosen, before what it leaves is given to others.
        """
        chosen: list[int] = []
        self.path = []
        self._taken = {}
        refused: set[str] = set()
        held: set[int] = set()
        seen: set[frozenset[int]] = {frozenset()}
        while len(chosen) < MOST_EFFECTS:
            gains, eligible = self.gains(chosen), self._eligible(chosen, refused)
            best = self._preferred(gains, [k for k in eligible if self.candidates[k].extends is None])
            best = self._preferred(gains, eligible) if best is None else best
            if best is None:
                break
            law = self._holding(chosen, best, gains, eligible)
            if law is None and self.improvement(chosen, best) < LEAST_IMPROVEMENT:
                refused.add(self.candidates[best].key)
                continue
            if law is not None:
                best = law
                held.add(law)
            # What it leaves open may be what others were taken for, at a standstill say.
            self.settle([*chosen, best])
            for _ in range(ROUNDS):
                refine([*chosen, best], best)
                if not self.settle([*chosen, best]):
                    break
            self._take([*chosen, best])
            chosen = self._revised([*chosen, best], refused, held)
            self.settle(chosen)
            self._take(chosen)
            # In the new weights, beside the others, an effect may have to be what it cannot be, or be none.
            while gone := [k for k in chosen if self._taken[k] <= self._least(k)]:
                refused |= {self.candidates[k].key for k in gone}
                chosen = [k for k in chosen if k not in gone]
                self.settle(chosen)
                self._take(chosen)
            if self.candidates[best].key in refused:
                continue
            if frozenset(chosen) in seen:
                break  # effects that replace each other in turn
            seen.add(frozenset(chosen))
            self.path.append((best, list(chosen)))
            if self.candidates[best].constant:
                # What it leaves while it is only approximately taken off must not be given to others.
                break
        return chosen

    def _holding(self, chosen: Sequence[int], best: int, gains: Sequence[Gain], allowed: Sequence[int]) -> int | None:
        """The dry friction that holds its axis much of the time where that tells held-out rows better than the best.

        Friction that holds an axis is any value, which many a column explains better than its law does. So these are
        compared by their likelihoods, with what each leaves open.
        """
        acts = self._acts(best)
        beside = [k for k in allowed if self._excess(k, gains[k]) > 0.0 and np.any(acts & self._acts(k))]
        laws = sorted((k for k in beside if self._holds(k)), key=lambda k: -gains[k].gain)[:RIVALS]
        if not laws:
            return None
        told = {k: self._deviance([*chosen, k]) for k in laws}
        law = min(laws, key=lambda k: told[k])
        others = [self._deviance(each) for each in ([*chosen, best], chosen) if law not in each]
        self.settle(chosen)
        return law if told[law] < min(others) - DECISIVE else None

    def _holds(self, k: int) -> bool:
        candidate = self.candidates[k]
        return self._laws is not None and candidate.traits.dry and self._laws.at_rest(candidate) > MUCH_REST

    def _deviance(self, chosen: Sequence[int]) -> float:
        """Minus twice the log of the likelihood of held-out rows beside those before them, up to a constant.

        Fitted to the other windows; what is left open goes with the coefficients from all of them.
        """
        for _ in range(ROUNDS):
            if not self.settle(chosen):
                break
        left = self._b - self._columns(chosen) @ self.solution(chosen, self.fitted)
        squares = left[: self.std.size].reshape(self.std.shape) ** 2
        return float(np.sum((squares + 2.0 * np.log(self.rows.white_std))[~self.fitted]))

    def _take(self, chosen: Sequence[int]) -> None:
        """Remember what each of the effects chosen takes beside the others."""
        self._taken = {}
        for k in chosen:
            Q = basis(self._columns([other for other in chosen if other != k]))
            found = gain(Q, free_of(Q, self._b[:, None])[:, 0], self._Z[k])
            self._taken[k] = self._plausible(self.candidates[k], found).gain

    def _least(self, k: int) -> float:
        """Gain that one of those chosen must have in the end: of dry friction what it leaves open may leave little."""
        dry = self.candidates[k].traits.dry
        return 0.0 if dry else threshold(FALSE_ALARM, self.trials, self._Z[k].shape[1])

    def _eligible(self, chosen: Sequence[int], refused: set[str]) -> list[int]:
        """Candidates that may come to those chosen; one that extends another comes after it, and then replaces it."""
        taken = {self.candidates[k].key for k in chosen}
        held = taken | self._declared
        return [
            k
            for k, candidate in enumerate(self.candidates)
            if candidate.key not in taken | refused and (candidate.extends is None or candidate.extends in held)
        ]

    def _revised(self, chosen: list[int], refused: set[str], held: set[int]) -> list[int]:
        """The same effects without those that the last one has made superfluous, each in its best form beside them.

        What takes an effect's place has to lower the residual of held-out rows. The last one stays though what it
        leaves open, which the rows bear by now, may leave little of its gain; and so do those held, which their
        likelihood has chosen.
        """
        last = chosen[-1]
        for k in list(chosen):
            others = [other for other in chosen if other != k]
            gains = self.gains(others)
            # What refines a law is a step of its own, and in place of no other effect.
            simple = [j for j in self._eligible(others, refused) if j == k or self.candidates[j].extends is None]
            best = self._preferred(gains, [*simple, k] if k not in simple else simple)
            if best is None or self._excess(k, gains[k]) <= 0.0:
                chosen = chosen if k == last or k in held else others
            elif (
                best != k
                and k not in held
                and not self._near(gains[k].gain, gains[best].gain)
                and self.improvement(others, best) >= LEAST_IMPROVEMENT
            ):
                chosen = [best if other == k else other for other in chosen]
        return chosen

    def improvement(self, chosen: Sequence[int], candidate: int) -> float:
        """Share by which the rms of the held-out rows that a candidate acts on falls, fitted to the other windows."""
        before = self._held_out([*chosen], candidate)
        after = self._held_out([*chosen, candidate], candidate)
        return 1.0 - after / before if before > 0.0 else 0.0

    def _held_out(self, chosen: Sequence[int], acting: int) -> float:
        left = self.residual(chosen, self.solution(chosen, self.fitted))[~self.fitted]
        return float(np.sqrt(np.mean(left[:, self._acts(acting)] ** 2)))

    def finding(self, chosen: Sequence[int], k: int) -> Finding:
        """What is to be said of one of the candidates chosen."""
        others = [other for other in chosen if other != k]
        gains = self.gains(others)
        improvement = self.improvement(others, k)
        own = gains[k]
        taken = {self.candidates[other].key for other in chosen}
        found = self.candidates[k]
        limit = threshold(FALSE_ALARM, self.trials, self._Z[k].shape[1])
        ambiguous = dict.fromkeys(
            candidate.key
            for j, candidate in enumerate(self.candidates)
            # A law and what refines it are no rivals.
            if candidate.key not in taken | {found.extends}
            and candidate.extends != found.key
            and gains[j].seen
            # What its own noise hides has no rivals to compare it with.
            and own.gain > limit
            and self._near(gains[j].gain, own.gain)
        )
        return Finding(self.candidates[k], own, limit, improvement, tuple(ambiguous))

    def ranking(self) -> list[Ranked]:
        """Every effect in its best form, by what it alone takes from the residual."""
        gains = self.gains([])
        r = free_of(basis(self._Y), self._b[:, None])[:, 0]
        # Where rows were given an error of their own, nothing may be beyond it: then shares are those of the best.
        whole = float(r @ r)
        excess = max(whole - r.size, *(g.gain for g in gains), float(np.finfo(np.float64).tiny))
        best: dict[str, int] = {}
        for k, candidate in enumerate(self.candidates):
            if candidate.key not in best or gains[k].gain > gains[best[candidate.key]].gain:
                best[candidate.key] = k
        ranked = []
        for k in best.values():
            gained = gains[k].gain
            chance = threshold(FALSE_ALARM, self.trials, self._Z[k].shape[1])
            explained = gained / whole if gained > chance else 0.0
            ranked.append(Ranked(self.candidates[k], gained, gained / excess, explained))
        return sorted(ranked, key=lambda entry: -entry.gain)

    def columns(self, chosen: Sequence[int]) -> Array:
        """Columns (W, n_v, n + c) of the model with those chosen."""
        return np.concatenate([self._model, *(self.candidates[k].columns for k in chosen)], axis=2)

    def solution(self, chosen: Sequence[int], windows: NDArray[np.bool_]) -> Array:
        """Parameters and coefficients (n + c,) of the model with those chosen, from some windows (W,)."""
        use = np.ones(len(self._b), dtype=bool)
        use[: windows.size * self._n_v] = np.repeat(windows, self._n_v)
        return least_squares(self._columns(chosen)[use], self._b[use])

    def covariance(self, chosen: Sequence[int], further: Array | None = None) -> Array:
        """Of the solution (n + c, n + c) from all windows, infinite where they tell nothing.

        further (W, n_v, s): columns of unknowns beside it, which come last.
        """
        beside = np.empty((self._b.size, 0)) if further is None else self._whitened(further)
        return solve(np.column_stack((self._columns(chosen), beside, self._b))).covariance()

    def residual(self, chosen: Sequence[int], solution: Array) -> Array:
        """What is left of every row (W, n_v) over its own deviation, see `settle`."""
        plain = np.concatenate([self._plain_model, *(self._plain[k] for k in chosen)], axis=2)
        return np.asarray(self.rows.b / self.std - plain @ solution)
