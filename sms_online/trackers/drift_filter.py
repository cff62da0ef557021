"""The information filter of parameters of which some move: one step of time, one block of rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sms_online.stream import Array
from sms_online.trackers.factor import extended, reduced, triangular_factor
from sms_online.trackers.interface import Rows

# Time from one step of the filter to the next, s, and steps from one knot that is looked back at to the next.
STEP, KNOT = 0.2, 5
# Number of a step before all, for clocks may begin at any time.
START = -KNOT * 2**50
# A direction of less information than this share of its column's is none, in a likelihood.
NO_INFORMATION = 1e-9
# Standard deviation of the time of a bend, s, which is anywhere between two knots.
BEND = KNOT * STEP / np.sqrt(12.0)


@dataclass(frozen=True)
class Block:
    """Rows between two knots, or their factor: columns [Y, (t - knot) Y, b], (k, 2 n + 1).

    knot: its number. rows: how many. span: s.
    """

    factor: Array
    knot: int
    rows: int
    span: float

    @staticmethod
    def of(rows: Array, knot: int, span: float) -> Block:
        """The block of whitened rows [Y, (t - knot) Y, b] (M, 2 n + 1) of `span` s."""
        return Block(reduced(rows), knot, len(rows), span)


def decaying(value: Array, ramp: Array, decay: float, span: float) -> Array:
    """Column of a rate that decays: the best line through its reach over a block of `span` s, to second order."""
    return np.asarray(np.exp(-0.5 * decay * span) * ramp + decay * span**2 / 12.0 * value)


def reach(decay: float, time: float) -> float:
    """How far a unit rate comes in a time, s, while it decays."""
    return time if decay == 0.0 else float(-np.expm1(-decay * time) / decay)


@dataclass(frozen=True)
class Moving:
    """Parameters that move together: their columns, since which knot, START for all of time, and their process noise.

    std: of each rate's walk, per √s. Where the drift was learned it is a share of the accepted `rates`. decay: of the
    rates, 1/s, as of what approaches an end. level, fading: places of both in the choice. breaks: knots at which values
    and rates begin anew, for they may have jumped. bends: knots before which rates have changed by their own size.
    begun: when the drift did, s, as far as that is known.
    """

    columns: tuple[int, ...]
    since: int
    std: float
    rates: tuple[float, ...] = ()
    decay: float = 0.0
    level: int = 0
    fading: int = 0
    breaks: tuple[int, ...] = ()
    bends: tuple[int, ...] = ()
    begun: float = 0.0

    @property
    def learned(self) -> bool:
        """Whether it was found in the rows."""
        return bool(self.rates)

    @property
    def changed(self) -> float | None:
        """Instant, s, of the last knot before which its rates became others; None where they never did."""
        later = [at * STEP for at in (*self.breaks, *self.bends) if at > self.since]
        return max(later, default=None)

    def noise(self) -> list[float]:
        """Process noise of each column's rate, per √s."""
        return [self.std * abs(rate) for rate in self.rates] if self.learned else [self.std] * len(self.columns)

    def broken(self, columns: tuple[int, ...], knot: int, rates: Array) -> Moving:
        """With a break at a knot where it is of these columns, whose rates change there by so much."""
        if self.columns != columns:
            return self
        largest = np.maximum(np.abs(self.rates), np.abs(rates)) if self.learned else ()
        return replace(self, breaks=(*self.breaks, knot), rates=tuple(float(rate) for rate in largest))

    def bent(self, knot: int) -> Moving:
        """With rates that have changed by their own size before a knot."""
        return replace(self, bends=(*self.bends, knot))

    def unbent(self, knot: int) -> Moving:
        """Without the bends behind a knot."""
        return replace(self, bends=tuple(at for at in self.bends if at <= knot))

    def remembered(self, knot: int) -> Moving:
        """Without the breaks and bends up to a knot, before which nothing is looked back at; the last of all stays."""
        last = max((*self.breaks, *self.bends), default=START)
        breaks, bends = (tuple(at for at in knots if at > knot or at == last) for knots in (self.breaks, self.bends))
        return replace(self, breaks=breaks, bends=bends)

    def at(self, level: int, time: float, fading: int, decay_time: float) -> Moving:
        """With a rate that changes by its own size in `time` s, and decays in `decay_time` s."""
        return replace(self, level=level, std=1.0 / np.sqrt(time), fading=fading, decay=1.0 / decay_time)


@dataclass(frozen=True)
class DriftFilter:
    """Information at a step on π (n,) and on the rates of those that move, (size + 1, size + 1).

    walks (n,): process noise of values, per √s. knot: number of the step, START before the first.
    """

    factor: Array
    moving: tuple[Moving, ...]
    walks: Array
    knot: int = START

    @staticmethod
    def begin(known: Array, moving: Sequence[Moving], walks: Array) -> DriftFilter:
        """From a factor on π, nothing known of rates."""
        return DriftFilter(known, (), walks).with_moving(moving)

    @property
    def n(self) -> int:
        """Number of parameters."""
        return int(self.walks.size)

    @property
    def size(self) -> int:
        """Number of states."""
        return len(self.factor) - 1

    def places(self) -> Iterator[tuple[int, int, float]]:
        """Column of what has begun to move, place of its rate among the states, and the rate's decay, 1/s."""
        place = self.n
        for each in self.moving:
            for column in each.columns:
                if each.since <= self.knot:
                    yield column, place, each.decay
                place += 1

    @property
    def uneven(self) -> bool:
        """Whether rates change: by process noise, because they decay, or at a break that is yet to come."""
        walks = any(
            each.decay > 0.0 or max(each.noise()) > 0.0 or max((*each.breaks, *each.bends), default=START) > self.knot
            for each in self.moving
        )
        return bool(self.walks.any() or walks)

    def all_moving(self) -> DriftFilter:
        """With everything moving from now on that moves later."""
        return replace(self, moving=tuple(replace(each, since=min(each.since, self.knot)) for each in self.moving))

    def with_moving(self, moving: Sequence[Moving]) -> DriftFilter:
        """With these moving, of which those that are there already come first; of further rates nothing is known."""
        rates = sum(len(each.columns) for each in moving)
        more = self.n + rates - self.size
        if more == 0:
            return replace(self, moving=tuple(moving))
        wide = np.zeros((self.size + more + 1, self.size + more + 1))
        wide[: self.size + 1, : self.size] = self.factor[:, :-1]
        wide[: self.size + 1, -1] = self.factor[:, -1]
        return replace(self, factor=triangular_factor(wide), moving=tuple(moving))

    def absorbed(self, block: Block) -> DriftFilter:
        """With a block's rows, of its knot."""
        state = replace(self, knot=block.knot)
        n = self.n
        rows = np.zeros((len(block.factor), self.size + 1))
        rows[:, :n], rows[:, -1] = block.factor[:, :n], block.factor[:, -1]
        for column, place, decay in state.places():
            rows[:, place] = decaying(block.factor[:, column], block.factor[:, n + column], decay, block.span)
        return replace(state, factor=extended(self.factor, rows))

    def advanced(self, knot: int) -> DriftFilter:
        """At a later knot."""
        time = (knot - self.knot) * STEP
        R = self.factor.copy()
        noisy = {int(k): float(self.walks[k]) * np.sqrt(time) for k in np.flatnonzero(self.walks)}
        for column, place, decay in self.places():
            # In terms of the later knot: rate before = rate / left, value before = value - rate before · reach.
            R[:, place] = (R[:, place] - reach(decay, time) * R[:, column]) / np.exp(-decay * time)
        noisy |= self._rate_noise(knot)
        if not noisy:
            return replace(self, factor=R if not list(self.places()) else triangular_factor(R), knot=knot)
        # States before = states after - noise; the noise's own information comes first, and is left behind.
        p = len(noisy)
        stacked = np.zeros((p + len(R), p + len(R)))
        stacked[p:, p:] = R
        for k, (place, std) in enumerate(noisy.items()):
            stacked[k, k] = 1.0 / std
            stacked[p:, k] = -R[:, place]
        return replace(self, factor=triangular_factor(stacked)[p:, p:], knot=knot)

    def _rate_noise(self, knot: int) -> dict[int, float]:
        """Standard deviations that rates gain on the way to a knot, and values at breaks and bends, by their places."""
        time, out = (knot - self.knot) * STEP, dict[int, float]()
        places = {column: place for column, place, _ in self.places()}
        for each in self.moving:
            broken, bent = (sum(self.knot < at <= knot for at in knots) for knots in (each.breaks, each.bends))
            sizes = np.sqrt(bent) * np.abs(each.rates) if each.learned else np.zeros(len(each.columns))
            for column, walk, size in zip(each.columns, each.noise(), sizes.tolist(), strict=True):
                if broken:
                    out[column] = np.inf
                if column not in places:
                    continue  # its rate begins at this knot
                if broken:
                    out[places[column]] = np.inf
                elif walk > 0.0 or size > 0.0:
                    out[places[column]] = float(np.hypot(walk * np.sqrt(time), size))
                if size > 0.0 and not broken:
                    out[column] = float(np.hypot(self.walks[column] * np.sqrt(time), size * BEND))
        return out


def innovation_loss(before: DriftFilter, after: DriftFilter) -> float:
    """Minus twice the log likelihood of a block given what was before it, but for a constant of the block's own."""
    logs = []
    for state in (before, after):
        own = np.abs(np.diag(state.factor)[:-1])
        size = np.linalg.norm(after.factor[:, :-1], axis=0)
        logs.append(float(np.sum(np.log(np.maximum(own, NO_INFORMATION * np.where(size > 0.0, size, 1.0))))))
    squares = after.factor[-1, -1] ** 2 - before.factor[-1, -1] ** 2
    return float(squares + 2.0 * (logs[1] - logs[0]))


def through(state: DriftFilter, blocks: Sequence[Block], end: int) -> tuple[DriftFilter, float]:
    """A filter behind some blocks, at step `end`, and minus twice the log likelihood of these."""
    loss = 0.0
    for k, block in enumerate(blocks):
        after = state.absorbed(block)
        loss += innovation_loss(state, after)
        state = after.advanced(blocks[k + 1].knot if k + 1 < len(blocks) else end)
    return state, loss


def expanded(rows: Rows, n: int) -> Array:
    """Whitened rows [Y, what rates add about t, b] (M, 2 n + 1)."""
    whitened = rows.whitened(n)
    rates = np.zeros_like(rows.Y) if rows.ramp is None else rows.ramp / rows.std[:, None]
    return np.concatenate((whitened[:, :-1], rates, whitened[:, -1:]), axis=1)


def block_of(windows: Sequence[Rows], knot: int, n: int) -> Block:
    """Rows of several windows as one block that begins at a knot."""
    after = [expanded(rows, n) for rows in windows]
    for rows, own in zip(windows, after, strict=True):
        own[:, n : 2 * n] += (rows.t - knot * STEP)[:, None] * own[:, :n]
    return Block.of(np.concatenate(after), knot, windows[-1].t[-1] - knot * STEP)
