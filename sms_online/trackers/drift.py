"""Parameters that drift: value and rate on knots, in square-root information form, drifts learned from the rows.

Between knots a moving parameter goes on a straight line, or on one that decays; at each knot its rate takes a step of
random size: a random walk of the rate. Which parameters move is learned: a parameter starts to move where a ramp of it
takes more off the rows' sum of squares than chance does, and more than any step. How freely its rate walks, and how
fast it decays, is learned too: the choice under which the innovations of the last half minute are likeliest, neither
unless they say more; and so is when it changes at once, see `rate_change`. A steady parameter keeps the error bars of
least squares.

A rate begins with no information at all, and most parameters have none: a covariance filter needs a finite variance
in its place, and loses the digits of what is well known to it. Information in square-root form has neither problem.
Sources: Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapters V and VI (time update of the
information filter); Harvey, Forecasting, Structural Time Series Models and the Kalman Filter, 1989, section 2.3 (local
linear trend) and 3.4 (likelihood of its innovations).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sms_online.stream import Array, Mask
from sms_online.trackers.drift_filter import (
    KNOT,
    START,
    STEP,
    Block,
    DriftFilter,
    Moving,
    block_of,
    expanded,
    innovation_loss,
    reach,
    through,
)
from sms_online.trackers.drift_noise import likeliest
from sms_online.trackers.drift_search import (
    LARGEST_LEFT,
    Break,
    Ramp,
    Tried,
    best_break,
    best_ramp,
    changes_within,
    explains,
    likeliest_change,
    ramp_before,
)
from sms_online.trackers.drift_state import DriftState, Found
from sms_online.trackers.factor import masked_covariance, solve, triangular_factor
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Estimate, Prior, Rows, Tracker, checked, prior_factor
from sms_online.trackers.rate_change import TRIED, branches

# Knots that are looked back at, for ramps and for process noise.
REMEMBERED = 32
# From one search for ramps to the next, and from one choice of process noise to the next, knots.
SEARCHED, CHOSEN = 2, 4
# Knots since the last drift began within which process noise is chosen at each: few rows show little of how it goes on.
YOUNG = 16
# Knots before the first search: the first rows have weights that change.
UNSEARCHED = 3
# Knots before an alarm within which a change of rates may be what it is of.
RECENT = 2
# Drifts that begin together, at most.
MOST_AT_ONCE = 4
# Knots with motion from the beginning within which more than noise may be a drift yet to be found; but not where ramps
# leave this share of it or more. An arm at rest shows neither.
PATIENCE, RAMPS_LEAVE = 12, 0.5
# A change is suspected where two searches in a row show one of the same parameters, the later with a chance of at most
# this to be none. In steady sessions one search in some 500 finds one, ten times as many as normal rows would: their
# noise is known to a tenth alone, and is not quite white.
SUSPECTED = 5e-4
# Chance that the earlier of the two has at most.
SHOWN = 0.1


class LearnedTrend(Tracker):
    """Least squares of π with those parameters on trends that show one.

    groups: columns that may move, each group as one hypothesis. trends: columns that move from the start, with the
    process noise (n,) of their rates, per √s; walks (n,): that of values on random walks, per √s. prior: of π. follow:
    whether what shows a trend moves from then on; without, trends are suspected alone.
    """

    def __init__(
        self,
        n: int,
        groups: Sequence[tuple[int, ...]],
        trends: Array,
        walks: Array,
        prior: Prior,
        follow: bool = True,
    ) -> None:
        self._follow = follow
        self._n, self._groups, self._prior = n, tuple(groups), prior_factor(prior, n)
        self._trends, self._walks = trends, walks
        self.begin(Information.none(self._n))

    def begin(self, known: Information) -> None:
        """Forget all rows, and go on from given information about π; the prior stays. Drifts are learned anew."""
        factor = triangular_factor(self._prior, checked(known, self._n).factor)
        moving = [Moving((int(k),), START, float(self._trends[k])) for k in np.flatnonzero(self._trends)]
        anchor = DriftFilter.begin(factor, moving, self._walks)
        self.state = DriftState(anchor, anchor, moving, rows=float(known.rows))

    def update(self, rows: Rows) -> None:
        """Take in rows; ValueError where their width is not n."""
        for row, t in zip(expanded(rows, self._n), rows.t.tolist(), strict=True):
            step = int(np.floor(t / STEP))
            if self.state.step == START:
                self.state.step = step
            if step > self.state.step:
                self._advance(step)
            row[self._n : -1] += (t - self._knot * STEP) * row[: self._n]
            self.state.pending.append(row)
            self.state.fresh += 1
            self.state.rows, self.state.newest = self.state.rows + 1.0, t

    def break_between(self, onset: float, alarm: float, behind: Sequence[Rows]) -> Break:
        """Whether a change that lies between two instants, s, is the beginning or a turn of a drift.

        behind: rows since the alarm, whitened among themselves.
        """
        before, moving = self._before(onset)
        if not before or not behind:
            return Break()
        block = block_of(behind, _knot(alarm), self._n)
        return best_break(self._through(before, moving, block.knot)[0], block, self._groups)

    def ramp_before(self, onset: float, alarm: float, behind: Sequence[Rows]) -> Break:
        """Whether the same is a drift that had begun before the alarm, too weak to be seen by then."""
        blocks, moving = self.state.blocks, self.state.moving
        if not blocks or not behind:
            return Break()
        block = block_of(behind, _knot(alarm), self._n)
        between = sum(each.knot + KNOT > onset / STEP for each in blocks) + 1
        free = self._free(moving, [*blocks, block])
        return ramp_before(self.state.anchor.with_moving(moving), [*blocks, block], free, self._groups, between)

    def go_on_behind(self, onset: float, alarm: float, drift: Ramp, behind: Sequence[Rows]) -> None:
        """Go on behind the break of a drift, or with one that had begun before it; behind: see `break_between`.

        Rows of the last knot before are given up.
        """
        (before, moving), knot, begin = self._before(onset), _knot(alarm), int(np.ceil(alarm / STEP))
        if drift.since < knot:
            before, moving = self.state.blocks, [*self.state.moving, drift.moving()]
        else:
            moving = [each.broken(drift.columns, knot, drift.rates) for each in moving]
            if not any(each.columns == drift.columns for each in moving):
                moving.append(replace(drift.moving(), breaks=(knot,), begun=onset))
        now = self._through(before, moving, begin)[0]
        self.state.blocks, self.state.changes = before, []
        self._move(moving, now)
        self.state.pending, self.state.fresh, self.state.step = [], 0, begin
        self.state.accepted += 1
        for rows in behind:
            self.update(rows)

    def _before(self, onset: float) -> tuple[list[Block], list[Moving]]:
        """Remembered blocks that end before an instant, s, and what moves in them.

        A change of rates that was taken for one shortly before may be the same change.
        """
        recent = [at for each in self.state.moving for at in each.bends if at > onset / STEP - RECENT * KNOT]
        end = min([int(onset / STEP), *(at - KNOT for at in recent)])
        moving = [each.unbent(end) for each in self.state.moving]
        return [block for block in self.state.blocks if block.knot + KNOT <= end], moving

    @property
    def _knot(self) -> int:
        """Step at which the open block began."""
        return self.state.step // KNOT * KNOT

    def _advance(self, step: int) -> None:
        """End the open step, and go on at a later one."""
        block, before, knot = self._open(), self.state.now, self._knot
        after = before.absorbed(block)
        loss = innovation_loss(before, after)
        changes = [each.absorbed(block, loss) for each in self.state.changes]
        self.state.now, self.state.step, self.state.fresh = after.advanced(step), step, 0
        if self._knot > knot:
            changes = [*changes, *branches(after, self._knot)]
        self.state.changes = [each.advanced(step) for each in changes]
        if self._knot > knot:
            self._close(Block.of(self._rows(), knot, KNOT * STEP))
        self._change()

    def _change(self) -> None:
        """Go on with the likeliest change of a rate where it is likelier than none; forget those of long ago."""
        best = max(self.state.changes, key=lambda each: each.gain, default=None)
        if best is not None and best.likelier > 0.0:
            self.state.changes = []
            self._move(list(best.filter.moving), best.filter)
        self.state.changes = [each for each in self.state.changes if each.knot > self._knot - TRIED * KNOT]

    def _close(self, block: Block) -> None:
        """Remember a block, and look back."""
        self.state.blocks.append(block)
        self.state.pending = []
        self.state.knots += 1
        due = self.state.knots % SEARCHED == 0
        self.state.shown += SEARCHED * (due and self.state.moves)
        while len(self.state.blocks) > REMEMBERED:
            gone = self.state.blocks.pop(0)
            following = self.state.blocks[0].knot
            self.state.anchor = self.state.anchor.absorbed(gone).advanced(following)
        if not self.state.quiet:
            self.state.likeliest = self.state.suspected = None
        elif self.state.knots > UNSEARCHED and due:
            self._search()
        self.state.moves = self.state.moves and not due
        found = [each.since for each in self.state.moving if each.learned]
        if found and (self.state.knots % CHOSEN == 0 or self._knot - max(found) < YOUNG * KNOT):
            self._choose()

    def _open(self) -> Block:
        """The open step's rows."""
        rows, n = self._rows()[len(self.state.pending) - self.state.fresh :], self._n
        rows[:, n : 2 * n] -= (self.state.step - self._knot) * STEP * rows[:, :n]
        return Block.of(rows, self.state.step, STEP)

    def _rows(self) -> Array:
        return np.array(self.state.pending).reshape(-1, 2 * self._n + 1)

    def _filtered(self, moving: Sequence[Moving]) -> tuple[DriftFilter, float]:
        """The filter behind the remembered blocks with these moving, and minus twice the log likelihood of those."""
        return self._through(self.state.blocks, moving, self.state.step)

    def _through(self, blocks: Sequence[Block], moving: Sequence[Moving], end: int) -> tuple[DriftFilter, float]:
        return through(self.state.anchor.with_moving(moving), blocks, end)

    def _search(self) -> None:
        """Whether one more parameter moves."""
        found, tried = list(self.state.moving), self._tried(self.state.moving)
        self._suspect(tried)
        for _ in range(MOST_AT_ONCE if self._follow else 0):
            ramp = best_ramp(tried)
            if ramp is None:
                break
            found.append(ramp.moving())
            tried = self._tried(found)
        new = len(found) > len(self.state.moving)
        ends = self.state.shown == PATIENCE and self.state.moves and not self.state.accepted
        judged = self.patient or ends or self.state.lacking
        if not new and not judged:
            return
        # A lack of the model leaves more than noise, whatever ramps it is taken for.
        left = self._excess(found)
        if new and left < LARGEST_LEFT - 1.0:
            self.state.moving, self.state.changes, self.state.lacking = found, [], False
            self._choose()
            self.state.accepted += 1
            self.state.likeliest = self.state.suspected = None
        elif judged:
            without = self._excess(self.state.moving) if new else left
            least = 0.0 if ends else RAMPS_LEAVE * without
            self.state.lacking = left >= max(LARGEST_LEFT - 1.0, least)

    def _excess(self, moving: Sequence[Moving]) -> float:
        """Mean square of what the remembered rows leave with these moving, less that of noise."""
        left = self._filtered(moving)[0].factor[-1, -1] ** 2 - self.state.anchor.factor[-1, -1] ** 2
        return float(left / sum(block.rows for block in self.state.blocks) - 1.0)

    def _tried(self, moving: Sequence[Moving]) -> Tried:
        """Changes of what does not move, within the remembered blocks."""
        blocks, free = self.state.blocks, self._free(moving, self.state.blocks)
        return changes_within(self.state.anchor.with_moving(moving), blocks, free, free)

    def _free(self, moving: Sequence[Moving], blocks: Sequence[Block]) -> list[tuple[int, ...]]:
        """Groups that do not move, nor say the same as what does."""
        taken = {column for each in moving for column in each.columns}
        rows = np.concatenate([block.factor[:, : self._n] for block in blocks])
        sizes = np.linalg.norm(rows, axis=0)
        return [group for group in self._groups if not taken & set(group) and not explains(rows, sizes, taken, group)]

    def _suspect(self, tried: Tried) -> None:
        """Whether a change is hardly chance, for the second time."""
        level = max(1.0, self.state.now.factor[-1, -1] ** 2 / max(1.0, self.state.rows - self._n))
        before, now = self.state.likeliest, likeliest_change(tried, level)
        again = before is not None and now is not None and before.columns == now.columns and before.chance < SHOWN
        hardly = now is not None and now.chance < SUSPECTED
        self.state.likeliest, self.state.suspected = now, now if again and hardly else None

    def _choose(self) -> None:
        """Process noise and decay of each that moves."""
        moving, now = likeliest(self.state.moving, self._filtered)
        if moving != self.state.moving:
            self.state.changes = []
        self._move(moving, now)

    def _move(self, moving: list[Moving], now: DriftFilter) -> None:
        """Go on with these moving, and their filter at the newest step."""
        moving = [each.remembered(self.state.anchor.knot) for each in moving]
        self.state.moving, self.state.now = moving, now.with_moving(moving)
        self.state.anchor = self.state.anchor.with_moving(moving)

    @property
    def patient(self) -> bool:
        """Whether more than noise may be a drift that is yet to be found."""
        return self.state.shown < PATIENCE and not self.state.lacking

    @property
    def instant(self) -> float:
        """Time that estimates hold for, s."""
        return max(self.state.newest, self.state.until)

    def _ahead(self, t: float = -np.inf) -> float:
        """Time from the open step to the instant that estimates hold for, or to a later one, s."""
        return 0.0 if self.state.step == START else max(self.instant, t) - self.state.step * STEP

    @property
    def information(self) -> Information:
        """What is known of π as it is at the newest row."""
        state = self.state.now.absorbed(self._open())
        factor, ahead = state.factor.copy(), self._ahead()
        for column, place, decay in state.places():
            factor[:, place] -= reach(decay, ahead) * factor[:, column]
        rates = range(self._n, state.size)
        kept = Information(factor, int(self.state.rows)).without(rates).factor
        return Information(triangular_factor(np.delete(kept, list(rates), axis=1)), int(self.state.rows))

    @property
    def found(self) -> tuple[Found, ...]:
        """The drifts that were learned so far."""
        rate, std, _ = self.rates()
        return tuple(
            Found(column, each.begun, float(rate[column]), float(std[column]), each.changed)
            for each in self.state.moving
            if each.learned
            for column in each.columns
        )

    @property
    def columns(self) -> list[int]:
        """Columns of the drifts that were learned so far."""
        return [column for each in self.state.moving if each.learned for column in each.columns]

    @property
    def moves(self) -> Mask:
        """Which parameters (n,) move, by trend or walk."""
        out = self._walks > 0.0
        for each in self.state.moving:
            out[list(each.columns)] = True
        return out

    def rates(self) -> tuple[Array, Array, Array]:
        """Rate of each parameter (n,) now, zero where it does not move, standard deviation, and decay (n,), 1/s."""
        state = self.state.now.absorbed(self._open())
        solution, ahead = solve(state.factor), self._ahead()
        rate, std, decays = np.zeros((3, self._n))
        covariance = solution.covariance()
        for column, place, decay in state.places():
            left = np.exp(-decay * ahead)
            rate[column], std[column] = left * solution.pi[place], left * np.sqrt(covariance[place, place])
            decays[column] = decay
        return rate, std, decays

    def estimate(self) -> Estimate:
        """π at the instant that estimates hold for; leaves the state as it is."""
        return self.estimate_at(-np.inf)

    def estimate_at(self, t: float, unsure: float = 0.0) -> Estimate:
        """The same at a later instant, s.

        unsure: s before it since when rates that were learned may be others, by their own size.
        """
        state = self.state.now.absorbed(self._open())
        solution = solve(state.factor)
        ahead = self._ahead(t)
        to_now = np.eye(self._n, state.size)
        determined = solution.determined[: self._n].copy()
        for column, place, decay in state.places():
            to_now[column, place] = reach(decay, ahead)
            determined[column] &= bool(solution.determined[place])
        root = to_now @ solution.root
        covariance = root @ root.T
        for each in self.state.moving if unsure > 0.0 else ():
            if each.learned:
                columns = list(each.columns)
                covariance[np.ix_(columns, columns)] += np.outer(each.rates, each.rates) * unsure**2
        return Estimate(
            pi=to_now @ solution.pi,
            covariance=masked_covariance(covariance, determined),
            covariance_robust=None,
            determined=determined,
            condition_number=solution.condition_number,
            rows=self.state.rows,
            rss=solution.rss,
            dof=max(self.state.rows + len(self._prior) - solution.rank, 0.0),
        )


def _knot(t: float) -> int:
    """Knot of the block that the next step behind an instant, s, is in."""
    return int(np.ceil(t / STEP)) // KNOT * KNOT
