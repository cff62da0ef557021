"""From a residual to the effects behind it: forward selection with cross-validation, and steps back.

Candidates compete for what the model leaves of the whitened rows. The best is selected where its gain is no accident
among all that were tried and where it lowers the residual of blocks of time that it was not fitted to, or where it is
friction that keeps its axis at rest and makes these likelier; then the rest compete for what is left. In the joint fit
of all that were selected each must be possible, significant and of use: what is not goes, and the search goes on.
A candidate that explains nearly as much as the one selected is named beside it as indistinguishable.
Source of the selection: Pati, Rezaiifar and Krishnaprasad, Asilomar Conf. Signals, Systems and Computers (1993) 40
(orthogonal matching pursuit); of the correction for many candidates: Bonferroni's inequality.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sms_online.diagnosis.acceptance import Acceptance
from sms_online.diagnosis.candidate import Finding, Ranked, Rival
from sms_online.diagnosis.candidate_rows import ROUNDS
from sms_online.diagnosis.evidence import Gain, basis, free_of, gain, gains, threshold
from sms_online.diagnosis.folds import fall

# Probability that a session without any effect beyond the model shows one.
FALSE_ALARM = 0.01
# Candidates whose columns differ by less than 10°, sin² = 0.03 of the gain, are ambiguous; so are those whose
# likelihoods differ by less than a factor of e^5.
SAME_SHARE = 0.03
DECISIVE = 10.0
# Share of what an effect explains that one that is like it explains of that.
SAME_PART = 0.5
# A curve is as smooth as leaves at most this multiple of what the best leaves of held-out rows.
HARDLY_MORE = 1.02
# Dry friction is found by its stiction where its axis is at rest for at least this share of a session.
MUCH_REST = 0.05
# Laws of it that are compared, with their shape constants, those that explain most.
RIVALS = 3
# At most so many effects are looked for in turn, where no other number is asked for.
MOST_EFFECTS = 8


class Tracing(Acceptance):
    """Searches the candidates for what the rows of a session leave.

    path: which candidate each step of the last search took, and all that were chosen then.
    """

    path: Sequence[tuple[int, list[int]]] = ()

    def _excess(self, k: int, g: Gain) -> float:
        """Gain beyond what an absent candidate reaches, and beyond what the laws of those found are uncertain by."""
        acts = self._acts(k)
        limit = threshold(FALSE_ALARM, self.trials, self._Z[k].shape[1])
        for other, taken in self._taken.items():
            if other != k and np.any(acts & self._acts(other)):
                limit = max(limit, self.candidates[other].traits.inexact * taken)
        return g.gain - limit

    def _left_over(self, k: int) -> float:
        """Gain that constants among those chosen may leave in the rows of a candidate."""
        acts = self._acts(k)
        return max((left for other, left in self._leaves.items() if np.any(acts & self._acts(other))), default=0.0)

    def _preferred(self, gains: Sequence[Gain], allowed: Sequence[int]) -> int | None:
        """The candidate to take: the best one, or one with fewer constants that takes nearly as much."""
        excess = {k: self._excess(k, gains[k]) for k in allowed}
        if not excess or max(excess.values()) <= 0.0:
            return None
        best = max(allowed, key=lambda k: excess[k])
        near = [k for k in allowed if excess[k] > 0.0 and self._near(gains[k].gain, gains[best].gain)]
        return min(near, key=lambda k: (self._constants(k), -gains[k].gain))

    def _curve(self, chosen: Sequence[int], gains: Sequence[Gain], allowed: Sequence[int]) -> int | None:
        """The curve that leaves least of held-out rows, or one with fewer coefficients that leaves hardly more."""
        left = {
            k: 1.0 - self.improvement(chosen, k).share
            for k in allowed
            if self.candidates[k].traits.learned and self._excess(k, gains[k]) > 0.0
        }
        near = [k for k in left if left[k] <= HARDLY_MORE * min(left.values())]
        return min(near, key=lambda k: (len(self.candidates[k].parameters), left[k]), default=None)

    @staticmethod
    def _near(one: float, best: float) -> bool:
        return one >= best - max(DECISIVE, SAME_SHARE * best)

    def _constants(self, k: int) -> int:
        """How many constants a candidate has, those of its shape included."""
        candidate = self.candidates[k]
        return len(candidate.parameters) + len(candidate.effect.coefficients)

    def run(
        self,
        refine: Callable[[Sequence[int], int], None],
        watch: Callable[[Sequence[int]], bool] = lambda chosen: False,
        start: Sequence[int] = (),
        most: int = MOST_EFFECTS,
    ) -> list[int]:
        """Numbers of the candidates found, in the order of what they explain.

        refine: improves the shape constants of one of those chosen, before what it leaves is given to others. watch:
        is called with those chosen before each further one; true ends the search with these. start: those that a
        search of nearly the same rows has found, to go on from. most: effects that are looked for in turn.
        """
        self.path, self._most = [], most
        self._taken: dict[int, float] = {}  # gains of the effects chosen
        self._leaves: dict[int, float] = {}
        self._refused: set[str] = set()
        self._held: set[int] = set()
        seen: set[frozenset[int]] = {frozenset()}
        self.weigh(start)
        chosen = self._begun_with(start, refine)
        while True:
            chosen = self._grown(chosen, seen, refine, watch)
            if watch(chosen) or any(self.candidates[k].constant for k in chosen):
                return chosen
            failing = self.failing(chosen, self._held)
            if failing is None:
                return chosen
            self._refused.add(self.candidates[failing].key)
            chosen = [k for k in chosen if k != failing]
            self.reweight(chosen)
            self._take(chosen)

    def _begun_with(self, start: Sequence[int], refine: Callable[[Sequence[int], int], None]) -> list[int]:
        """Those of a search before that are of use in these rows too, each in its best form beside the others."""
        if not start:
            return []
        self._take(start)
        chosen = self._without_refused(self._revised(list(start)))
        self._refused = set()  # beside others they may be of use again
        self.path = [(k, chosen[: n + 1]) for n, k in enumerate(chosen)]
        for k in chosen:
            # In other weights its shape may have been known to a thousandth alone.
            refine(chosen, k)
        self.reweight(chosen)
        self._take(chosen)
        return chosen

    def _grown(
        self,
        chosen: list[int],
        seen: set[frozenset[int]],
        refine: Callable[[Sequence[int], int], None],
        watch: Callable[[Sequence[int]], bool],
    ) -> list[int]:
        """Those chosen and what comes to them, one effect after the other; seen: sets of effects so far."""
        useless: set[str] = set()
        found, deviances = self.gains(chosen), dict[int | None, float]()
        while len(chosen) < self._most and not watch(chosen):
            eligible = self._eligible(chosen, self._refused | useless)
            # What a constant leaves while it is only approximately taken off must not be given to others.
            eligible = [k for k in eligible if found[k].gain > self._left_over(k)]
            laws = [k for k in eligible if not self.candidates[k].traits.learned]
            # Simple laws first, then those that refine them, and curves where no law is of use.
            best = self._preferred(found, [k for k in laws if self.candidates[k].extends is None])
            best = self._preferred(found, laws) if best is None else best
            best = self._curve(chosen, found, eligible) if best is None else best
            if best is None:
                break
            law = self._stiction_instead(chosen, best, found, laws, deviances)
            if law is None and not self.improves(chosen, best):
                useless.add(self.candidates[best].key)
                continue
            if law is not None:
                best = law
                self._held.add(law)
            # What its law does not determine may be what others were taken for, at a standstill say.
            self.reweight([*chosen, best])
            for _ in range(ROUNDS):
                refine([*chosen, best], best)
                if not self.reweight([*chosen, best]):
                    break
            self._take([*chosen, best])
            chosen = self._without_refused(self._revised([*chosen, best]))
            if self.candidates[best].key in self._refused:
                found, deviances = self.gains(chosen), {}
                continue
            if frozenset(chosen) in seen:
                break  # effects that replace each other in turn
            seen.add(frozenset(chosen))
            self.path = [*self.path, (best, list(chosen))]
            # Beside it others may be of use that were none before.
            useless = set()
            found, deviances = self.gains(chosen), {}
        return chosen

    def _without_refused(self, chosen: list[int]) -> list[int]:
        """Those chosen but for effects that, with the rows whitened anew, are implausible or gain too little.

        These are refused from then on.
        """
        self.reweight(chosen)
        self._take(chosen)
        while gone := [k for k in chosen if self._taken[k] <= self._least(k) and not self._holds_scale(k, chosen)]:
            self._refused |= {self.candidates[k].key for k in gone}
            chosen = [k for k in chosen if k not in gone]
            self.reweight(chosen)
            self._take(chosen)
        return chosen

    def _stiction_instead(
        self,
        chosen: Sequence[int],
        best: int,
        gains: Sequence[Gain],
        allowed: Sequence[int],
        known: dict[int | None, float],
    ) -> int | None:
        """The law of dry friction to take in place of the best candidate, where stiction explains the rows better.

        Stiction is any value up to breakaway, which many a column explains better than its law does. So these are
        compared by their likelihoods, with the covariance of what each does not determine. known: deviances beside
        those chosen so far, of one candidate more or of none, to be added to.
        """
        acts = self._acts(best)
        beside = [k for k in allowed if self._excess(k, gains[k]) > 0.0 and np.any(acts & self._acts(k))]
        laws = sorted((k for k in beside if self._holds(k)), key=lambda k: -gains[k].gain)[:RIVALS]
        if not laws:
            return None
        before = len(known)
        for k in laws:
            if k not in known:
                known[k] = self._deviance([*chosen, k], acting=k)
        law = min(laws, key=lambda k: known[k])

        def deviance(rival: int | None) -> float:
            if rival not in known:
                known[rival] = self._deviance(chosen if rival is None else [*chosen, rival])
            return known[rival]

        rivals = [rival for rival in (None, best) if rival != law]
        decisive = known[law] < np.inf and all(known[law] < deviance(rival) - DECISIVE for rival in rivals)
        if len(known) > before:
            self.reweight(chosen)
        return law if decisive else None

    def _holds(self, k: int) -> bool:
        candidate = self.candidates[k]
        return self._laws is not None and candidate.traits.dry and self._laws.at_rest(candidate) > MUCH_REST

    def _deviance(self, chosen: Sequence[int], acting: int | None = None) -> float:
        """Minus twice the log of the likelihood of held-out rows beside those before them, up to a constant.

        Fitted to the other windows; what is not determined goes with the coefficients from all of them. acting: one of
        those chosen; where rows that it acts on leave more than noise whatever is added, any large variance at rest
        would make them likelier, and the deviance is infinite.
        """
        if acting is not None and self.stays_exceeding(chosen, acting):
            return np.inf
        self._iterated(chosen)
        if acting is not None and np.any(self.floor[self._acts(acting)]):
            return np.inf
        columns, deviance = self._columns(chosen), np.log(self.rows.white_std) * 2.0
        total = 0.0
        for k, solution in enumerate(self.solutions(chosen)):
            left = self._b - columns @ solution
            squares = left[: self.std.size].reshape(self.std.shape) ** 2
            total += float(np.sum((squares + deviance)[self.folds.predicted(k)]))
        return total

    def _take(self, chosen: Sequence[int]) -> None:
        """Remember what each of the effects chosen takes beside the others, and what a constant leaves of that."""
        self._taken, self._leaves = {}, {}
        for k in chosen:
            (found,) = gains(*self.left([other for other in chosen if other != k]), [self._Z[k]])
            self._taken[k] = self._plausible(self.candidates[k], found).gain
            self._leaves[k] = self._taken[k] * self.candidates[k].left_over(found.coefficients)

    def _least(self, k: int) -> float:
        """Gain that one of those chosen must have in the end: stiction may leave little of dry friction's."""
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

    def _revised(self, chosen: list[int]) -> list[int]:
        """The same effects without those that the last one has made superfluous, each in its best form beside them.

        What takes an effect's place has to lower the residual of held-out rows. The last one stays though what it does
        not determine, which the rows' covariance includes by now, may leave little of its gain; so do those held, which
        their likelihood has chosen.
        """
        last = chosen[-1]
        for k in list(chosen):
            if self._holds_scale(k, chosen):
                continue
            others = [other for other in chosen if other != k]
            gains = self.gains(others)
            # What refines a law is a step of its own, and in place of no other effect.
            simple = [j for j in self._eligible(others, self._refused) if j == k or self._simple(j, k)]
            best = self._preferred(gains, [*simple, k] if k not in simple else simple)
            if best is None or self._excess(k, gains[k]) <= 0.0:
                chosen = chosen if k == last or k in self._held else others
            elif (
                best != k
                and k not in self._held
                and not self._near(gains[k].gain, gains[best].gain)
                and self.improves(others, best)
            ):
                chosen = [best if other == k else other for other in chosen]
        return chosen

    def _holds_scale(self, k: int, chosen: Sequence[int]) -> bool:
        """Whether a fit without one of those chosen shrinks the parameters: then nothing can be compared with it."""
        others = [other for other in chosen if other != k]
        return self.shrinks(others) and not self.shrinks(chosen)

    def _simple(self, j: int, k: int) -> bool:
        """Whether a candidate may take the place of another: no refinement of a law, and a curve that of itself."""
        one, other = self.candidates[j], self.candidates[k]
        return one.extends is None and (not one.traits.learned or one.key == other.key)

    def finding(self, chosen: Sequence[int], k: int) -> Finding:
        """The finding of one of the candidates chosen."""
        others = [other for other in chosen if other != k]
        gains = self.gains(others)
        improvement = self.improvement(others, k).share
        own = gains[k]
        Q, _ = self.left(others)
        part = free_of(Q, self._Z[k]) @ own.coefficients
        taken = {self.candidates[other].key for other in chosen}
        found = self.candidates[k]
        limit = threshold(FALSE_ALARM, self.trials, self._Z[k].shape[1])
        ambiguous = dict.fromkeys(
            candidate.key
            for j, candidate in enumerate(self.candidates)
            # A law and what refines it are no rivals.
            if candidate.key not in taken | {found.extends}
            and candidate.extends != found.key
            and (found.traits.learned or not candidate.traits.learned)
            and gains[j].seen
            # What its own noise hides has no rivals to compare it with.
            and own.gain > limit
            and gains[j].gain > SAME_PART * own.gain
            # Nor are two that explain as much of different rows.
            and gain(Q, part, self._Z[j]).gain > SAME_PART * float(part @ part)
            and (self._near(gains[j].gain, own.gain) or self._undecided(others, k, j))
        )
        acts, known = self._acts(k), {*taken, *ambiguous}
        beside = (j for j, g in enumerate(gains) if g.gain > 0.0 and np.any(acts & self._acts(j)))
        rivals = [j for j in beside if self.candidates[j].key not in known and not self.candidates[j].traits.learned]
        nearest = max(rivals, key=lambda j: gains[j].gain, default=None)
        rival = None
        if nearest is not None:
            rival = Rival(self.candidates[nearest].key, self.improvement(others, nearest).share)
        return Finding(found, own, limit, improvement, tuple(ambiguous), rival)

    def _undecided(self, others: Sequence[int], k: int, j: int) -> bool:
        """Whether held-out rows do not decide between two candidates, where these leave more than noise.

        There a likelihood, which takes all of it for noise, is surer than blocks of time are.
        """
        acts = self._acts(k)
        if not np.all(self.floor[acts] > 0.0):
            return False
        left = (self.held_out([*others, one], others)[:, acts].sum(axis=1) for one in (j, k))
        return not fall(*left).certain

    def ranking(self) -> list[Ranked]:
        """Every effect in its best form, by what it alone takes from the residual."""
        gains = self.gains([])
        r = free_of(basis(self._Y), self._b[:, None])[:, 0]  # without calibration
        whole = max(float(r @ r), float(np.finfo(np.float64).tiny))
        best: dict[str, int] = {}
        for k, candidate in enumerate(self.candidates):
            if candidate.key not in best or gains[k].gain > gains[best[candidate.key]].gain:
                best[candidate.key] = k
        ranked = []
        for k in best.values():
            gained = gains[k].gain
            chance = threshold(FALSE_ALARM, self.trials, self._Z[k].shape[1])
            explained = min(1.0, gained / whole) if gained > chance else 0.0
            ranked.append(Ranked(self.candidates[k], gained, explained))
        return sorted(ranked, key=lambda entry: -entry.gain)
