"""Which parameter has begun to drift: ramps of each from several starts, against steps, by what they explain."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from sms_online.stream import Array
from sms_online.trackers.drift_filter import STEP, Block, DriftFilter, Moving, decaying, through
from sms_online.trackers.factor import extended

# Starts of a ramp that are tried, knots before now.
STARTS = (4, 8, 16, 32)
# And those of a change that has given an alarm: the last block is all that is behind it.
STARTS_BEFORE_ALARM = (1, 2, 3, 4, 8, 16, 32)
# Blocks that are left out for a step which lies in the first of them: rows of the next hold parameters of before it.
STEPPED = 2
# What a ramp must take off the rows' sum of squares, for each parameter in it: 6.3 standard deviations of chance, of
# some 1e5 that are tried in an hour.
LEAST_GAIN = 40.0
# And so much more than a step, and than a ramp of another parameter.
DECISIVE = 10.0
# Mean square of the whitened rows up to which they hold no more than noise.
LARGEST_LEFT = 1.3
# What a drift may leave beside noise behind a break, as a share of what it takes off beyond a step: whitened rows hold
# some of the parameters of before it.
UNEXPLAINED = 0.02
# A column of which the others leave less than this share moves with them, and cannot be seen alone.
FREE = 1e-6


@dataclass(frozen=True)
class Ramp:
    """A drift that the rows show: columns that move together since a knot, at these rates; of a step, by these sizes.

    gain: what it takes off the rows' sum of squares.
    """

    columns: tuple[int, ...]
    since: int
    rates: Array
    gain: float

    def moving(self) -> Moving:
        """The parameters as they move from then on, without process noise."""
        return Moving(self.columns, self.since, 0.0, tuple(self.rates.tolist()), begun=self.since * STEP)


@dataclass(frozen=True)
class Tried:
    """Changes of parameters that may lie within the last blocks: ramps of each group from each start, and steps.

    left: by the starts' knots, what is left of the ramps' columns, and their sizes.
    """

    ramps: list[Ramp]
    steps: list[Ramp]
    left: dict[int, tuple[Array, Array]]


@dataclass(frozen=True)
class Suspicion:
    """A change that rows show and no tracker follows. columns: which may move. since: knot. chance: that it is none."""

    columns: tuple[int, ...]
    since: int
    chance: float


def changes_within(
    anchor: DriftFilter,
    blocks: Sequence[Block],
    ramps: Sequence[tuple[int, ...]],
    steps: Sequence[tuple[int, ...]],
    starts: Sequence[int] = STARTS,
) -> Tried:
    """What ramps of some groups, and steps of some, explain of the last blocks, from each start, blocks before the end.

    anchor: what is known before the blocks.
    """
    n = anchor.n
    tried = Tried([], [], {})
    # Everything from the anchor to each start, then everything after it.
    state, before = replace(anchor, knot=blocks[0].knot), {}
    for k, block in enumerate(blocks):
        before[len(blocks) - k] = state
        following = blocks[k + 1].knot if k + 1 < len(blocks) else block.knot + 1
        state = state.absorbed(block).advanced(following)
    for start in starts:
        if start > len(blocks):
            break
        since = blocks[-start].knot
        left, columns = _left(before[start].all_moving(), blocks[-start:], n)
        tried.left[since] = left[:, n:-1], columns[n:]
        for group in ramps:
            gain, rates = _explained(left, columns, [n + k for k in group])
            tried.ramps.append(Ramp(group, since, rates, gain))
        for group in steps:
            gain, sizes = _explained(left, columns, list(group))
            tried.steps.append(Ramp(group, since, sizes, gain))
    return tried


def best_ramp(tried: Tried) -> Ramp | None:
    """The ramp that explains most, if it is neither chance nor a step."""
    if not tried.ramps:
        return None
    best = _best(tried.ramps)
    left, sizes = tried.left[best.since]
    alike = [each.columns for each in tried.ramps if explains(left, sizes, each.columns, best.columns)]
    best = _first(best, [each for each in tried.ramps if each.since == best.since and each.columns in alike])
    steps = max((each.gain for each in tried.steps), default=0.0)
    others = max((each.gain for each in tried.ramps if each.columns not in alike), default=0.0)
    enough = best.gain > LEAST_GAIN * len(best.columns)
    return best if enough and best.gain > max(steps, others) + DECISIVE * len(best.columns) else None


def explains(rows: Array, sizes: Array, columns: Iterable[int], others: Iterable[int]) -> bool:
    """Whether some columns (M, ·) explain all that others do: those are no rival, but the same in other words.

    A payload on a rigid link is a heavier link. sizes: of the columns before anything was taken from them.
    """
    inside, outside = rows[:, list(columns)], rows[:, list(others)]
    norm = np.linalg.norm(inside, axis=0)
    inside = inside / np.where(norm > 0.0, norm, 1.0)
    rest = outside - inside @ np.linalg.lstsq(inside, outside, rcond=None)[0]
    return bool((np.linalg.norm(rest, axis=0) <= FREE * sizes[list(others)]).all())


def likeliest_change(tried: Tried, level: float) -> Suspicion | None:
    """The change that chance explains least, whatever its shape; None where none was tried.

    level: mean square of the whitened rows, at least 1. Its chance counts all that were tried.
    """
    both = [*tried.ramps, *tried.steps]
    chances = [float(chdtrc(len(each.columns), each.gain / level)) for each in both]
    if not both:
        return None
    best = int(np.argmin(chances))
    return Suspicion(both[best].columns, both[best].since, min(1.0, len(both) * chances[best]))


@dataclass(frozen=True)
class Break:
    """What rows behind a change show. drift: one that began or changed there, None where they show none.

    unclear: where they do not, no step explains clearly more than a drift, which may yet be chance, or more than noise
    is left so far.
    """

    drift: Ramp | None = None
    unclear: bool = False


def ramp_before(
    anchor: DriftFilter,
    blocks: Sequence[Block],
    ramps: Sequence[tuple[int, ...]],
    steps: Sequence[tuple[int, ...]],
    between: int,
) -> Break:
    """Whether a change that has given an alarm is that of a ramp which had begun before it.

    blocks: the last is all that is behind the alarm, and the change lies in one of the last `between` before it. Within
    a block nobody knows when a step was, so the ramp must explain more than steps with each of these left out.
    """
    last = len(blocks) - 1
    found: list[Ramp | None] = []
    unclear = True
    for k in range(max(0, last - between), last):
        kept = [*blocks[:k], *blocks[min(k + STEPPED, last) :]]
        tried = changes_within(anchor, kept, ramps, steps, STARTS_BEFORE_ALARM)
        found.append(best_ramp(tried))
        best, step = (max((each.gain for each in some), default=0.0) for some in (tried.ramps, tried.steps))
        unclear &= best > max(LEAST_GAIN, step - DECISIVE)
    whole = best_ramp(changes_within(anchor, blocks, ramps, steps, STARTS_BEFORE_ALARM))
    if not found or whole is None or whole.since == blocks[-1].knot:
        return Break(unclear=bool(found) and unclear)
    if not all(each is not None and each.columns == whole.columns for each in found):
        return Break(unclear=unclear)
    # Nothing but noise is left, since it began and behind the alarm.
    moving, since = (
        anchor.with_moving([*anchor.moving, whole.moving()]),
        [each.knot for each in blocks].index(whole.since),
    )
    rests = [through(moving, blocks[:k], blocks[k].knot)[0] for k in (since, last)]
    rests.append(rests[-1].absorbed(blocks[-1]))
    parts = zip(rests, rests[1:], (blocks[since:last], blocks[last:]), strict=False)
    noise = all(
        after.factor[-1, -1] ** 2 - before.factor[-1, -1] ** 2 <= LARGEST_LEFT * sum(each.rows for each in part)
        for before, after, part in parts
    )
    return Break(whole if noise else None, unclear=True)


def best_break(before: DriftFilter, after: Block, groups: Sequence[tuple[int, ...]]) -> Break:
    """Whether a change is that of a drift, or a step.

    before: what is known up to the knot of the rows behind it, `after`; those in between are left out, for nobody knows
    when within them it was. So a value may jump there beside its rate, and is compared with its step alone.
    """
    n = before.n
    left, sizes = _left(before.all_moving(), [after], n)
    steps = max((_explained(left, sizes, list(group))[0] for group in groups), default=0.0)
    tried: list[Ramp] = []
    for group in groups:
        gain, values = _explained(left, sizes, _with_ramps(group, n))
        tried.append(Ramp(group, after.knot, values[len(group) :], gain))
    if not tried:
        return Break()
    best = _best(tried)
    own = _with_ramps(best.columns, n)
    alike = [each for each in tried if explains(left, sizes, _with_ramps(each.columns, n), own)]
    best = _first(best, alike)
    others = max((each.gain for each in tried if all(each is not other for other in alike)), default=0.0)
    size = len(best.columns)
    rest = float(left[:, -1] @ left[:, -1]) - before.factor[-1, -1] ** 2 - best.gain
    if rest > max(LARGEST_LEFT * after.rows, after.rows + UNEXPLAINED * (best.gain - steps)):
        return Break(unclear=True)
    if best.gain - steps > (LEAST_GAIN + DECISIVE) * size and best.gain - others > DECISIVE * size:
        return Break(best)
    return Break(unclear=best.gain - steps > DECISIVE * size)


def _best(tried: Sequence[Ramp]) -> Ramp:
    """The ramp that explains most beyond what its parameters cost; the first of several."""
    return max(tried, key=lambda each: each.gain - LEAST_GAIN * len(each.columns))


def _first(best: Ramp, alike: Sequence[Ramp]) -> Ramp:
    """The first of those that say the same as the best, of no more parameters."""
    return next((each for each in alike if len(each.columns) == len(best.columns)), best)


def _with_ramps(group: tuple[int, ...], n: int) -> list[int]:
    """Columns of values and their ramps."""
    return [*group, *(n + k for k in group)]


def _left(state: DriftFilter, blocks: Sequence[Block], n: int) -> tuple[Array, Array]:
    """What static parameters and those that move leave of [steps, ramps, b] since the state's knot; and columns' sizes.

    Steps and ramps are carried through the filter like further right-hand sides, so what it leaves of them accounts for
    its process noise.
    """
    size, since = state.size, state.knot
    wide = np.zeros((size + 2 * n + 1, size + 2 * n + 1))
    wide[: size + 1, :size], wide[: size + 1, -1] = state.factor[:, :-1], state.factor[:, -1]
    state, squares = replace(state, factor=wide), np.zeros(2 * n)
    runs = [[block] for block in blocks] if state.uneven else [list(blocks)]
    for k, run in enumerate(runs):
        own = np.concatenate([_relative(block, run[0].knot, state) for block in run])
        rows = np.zeros((len(own), wide.shape[1]))
        rows[:, :n] = own[:, :n]
        for column, place, decay in state.places():
            span = sum(block.span for block in run)
            rows[:, place] = decaying(own[:, column], own[:, n + column], decay, span)
        rows[:, size:] = own
        # Ramps begin where all begins.
        rows[:, size + n : -1] += (run[0].knot - since) * STEP * own[:, :n]
        squares += np.sum(rows[:, size:-1] ** 2, axis=0)
        state = replace(state, factor=extended(state.factor, rows))
        if k + 1 < len(runs):
            state = state.advanced(runs[k + 1][0].knot)
    return state.factor[size:, size:], np.sqrt(squares)


def _relative(block: Block, knot: int, state: DriftFilter) -> Array:
    """A block's factor with times relative to a knot."""
    factor, n = block.factor.copy(), state.n
    factor[:, n : 2 * n] += (block.knot - knot) * STEP * factor[:, :n]
    return factor


def _explained(left: Array, sizes: Array, columns: Sequence[int]) -> tuple[float, Array]:
    """By how much columns reduce the sum of squares of the last one, and their coefficients."""
    inside = left[:, columns]
    norm = np.linalg.norm(inside, axis=0)
    if not (norm > FREE * sizes[columns]).all():
        return 0.0, np.zeros(len(columns))
    coefficients, *_ = np.linalg.lstsq(inside / norm, left[:, -1], rcond=None)
    rest = left[:, -1] - inside @ (coefficients / norm)
    return float(left[:, -1] @ left[:, -1] - rest @ rest), coefficients / norm
