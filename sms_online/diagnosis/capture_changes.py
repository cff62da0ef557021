"""Parameters that jump within a capture: a payload that is grasped, a spring that breaks.

Nothing that is constant explains such a capture, so a search would name effects that there are not. A jump shows in
rows that two fits explain, one of the windows before a time and one of those behind it, and no fit of all: each has all
candidates, so an effect that is lacking is no jump. What has jumped is one parameter, a group of them or a candidate
that takes off nearly all of what the two fits do.
Source: Andrews, Econometrica 61 (1993) 821 (tests for a break at an unknown time).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from sms_online.diagnosis.attempt import Attempt
from sms_online.diagnosis.evidence import basis, free_of, gains, least_squares
from sms_online.model.parameters import Parameter
from sms_online.pipeline.event_hypotheses import PAYLOAD, hypotheses, kind_of
from sms_online.pipeline.events import Event
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.stream import Array, Block
from sms_online.verdict.reasons import place_of

# Times that are tried in a capture.
TIMES = 100
# Rows on either side, for each column: with fewer a fit explains anything.
ROWS_EACH = 3
# Two fits leave at most this share of what one leaves beyond noise.
LEFT = 0.05
# The jump takes at least this share of what they do.
EXPLAINED = 0.9
# The part before it is what a system file describes, and is diagnosed if it is at least this share of that behind it.
LEAST_BEFORE = 0.5

# What jumps, and its columns (W, n_v, ·), whitened.
_Jump = tuple[tuple[Parameter, ...], Array]


@dataclass(frozen=True)
class CaptureChange:
    """A jump of parameters within a capture, and which part was diagnosed.

    event: what has jumped, and when. before: whether the part before it was diagnosed, or that behind it.
    """

    event: Event
    before: bool

    @property
    def places(self) -> tuple[str, ...]:
        """Where on the arm it sits."""
        return tuple(dict.fromkeys(chain.from_iterable(map(place_of, self.event.parameters))))

    @property
    def sentence(self) -> str:
        """In words."""
        event, part = self.event, "before it" if self.before else "behind it"
        each = zip(event.parameters, event.sizes, event.stds, event.units, strict=True)
        first, *more = [(name, f"by {size:+.3g} ± {std:.1g} {unit}".rstrip()) for name, size, std, unit in each]
        jumps = ", ".join([f"{first[0]} jumps {first[1]}", *(f"{name} {by}" for name, by in more)])
        return f"at {event.time:.1f} s {jumps}: diagnosed {part}"


def find_change(attempt: Attempt, start: float, chosen: Sequence[int] | None = None) -> Event | None:
    """The jump in the capture of an attempt.

    start: time of the capture's first sample, s. chosen: candidates that the fits have, all laws unless given. None
    where there is no single jump.
    """
    tracing, base, time = attempt.tracing, attempt.rows.base, attempt.rows.time
    laws = [k for k, candidate in enumerate(tracing.candidates) if not candidate.traits.learned]
    std = tracing.std[..., None]
    columns, b = tracing.columns(laws if chosen is None else chosen) / std, attempt.rows.b[..., None] / std
    split = _best_split(np.concatenate((columns, b), axis=2))
    if split is None:
        return None
    behind = (np.arange(len(time)) >= split.last).astype(np.float64)[:, None, None]

    def known(part: Array) -> Array:
        """Rows (M, ·) of all windows but those that may hold the jump."""
        return np.concatenate((part[: split.first], part[split.last :])).reshape(-1, part.shape[2])

    Q = basis(known(columns))
    jumps = [
        (tuple(base.parameters[k] for k in jump.columns), columns[..., list(jump.columns)])
        for jump in hypotheses(base.parameters)
    ]
    added = [(tracing.candidates[k].parameters, tracing.candidates[k].columns / std) for k in laws]
    jumps += [*added, *_off_centre(jumps, added)]
    found = gains(Q, free_of(Q, known(b))[:, 0], [known(part * behind) for _, part in jumps])
    # Of those that explain it that of fewest parameters.
    enough = [k for k, each in enumerate(found) if each.gain > EXPLAINED * split.taken]
    if not enough:
        return None
    best = min(enough, key=lambda k: (len(jumps[k][0]), -found[k].gain))
    own = jumps[best][0]
    # Deviations are those of rows that scatter as the two fits leave them.
    stds = np.sqrt(np.diag(found[best].covariance) * max(1.0, split.variance))
    return Event(
        time=start + 0.5 * float(time[split.at - 1] + time[split.at]),
        kind=kind_of([each.name for each in own]),
        parameters=tuple(each.name for each in own),
        units=tuple(each.unit for each in own),
        sizes=tuple(found[best].coefficients.tolist()),
        stds=tuple(stds.tolist()),
        dropped_windows=split.last - split.first,
    )


def diagnosed_part(run: Sequence[Block], event: Event, apart: float) -> tuple[list[Block], CaptureChange]:
    """The part of a capture before an event, or behind it; apart: s on either side of it that belong to none."""
    before = event.time - run[0].t[0] >= LEAST_BEFORE * (run[-1].t[-1] - event.time)
    kept = [(block, block.t < event.time - apart if before else block.t > event.time + apart) for block in run]
    part = [Block(block.t[some], block.channels, block.values[some]) for block, some in kept if some.any()]
    return part, CaptureChange(event, bool(before))


def _off_centre(jumps: Sequence[_Jump], added: Sequence[_Jump]) -> Iterator[_Jump]:
    """A payload whose centre of mass is not in the tip: a mass there, and all that the last link shows of a body."""
    single = [each for each in jumps if len(each[0]) == 1 and "@" not in each[0][0].name]
    links = [each for each in single if each[0][0].name.startswith("link_")]
    if not links:
        return
    last = max(_link(each) for each in links)
    for parameters, columns in added:
        if kind_of([each.name for each in parameters]) == PAYLOAD:
            own = [each for each in links if _link(each) == last]
            body = parameters, *(each[0] for each in own)
            yield tuple(chain.from_iterable(body)), np.concatenate([columns, *(each[1] for each in own)], axis=2)


def _link(jump: _Jump) -> int:
    """Number of the link of a jump's first parameter."""
    return int(jump[0][0].name.partition(".")[0].removeprefix("link_"))


@dataclass(frozen=True)
class _Split:
    """Two fits of a capture: one of the windows before `first`, and one of those from `last` on.

    at: the window from which on the second one fits those between better, in the middle of those that hold the jump.
    taken: what they take off the sum of squares of one fit of both. variance: mean square that they leave.
    """

    first: int
    last: int
    at: int
    taken: float
    variance: float


def _best_split(rows: Array) -> _Split | None:
    """Where two fits of rows [A b] (W, n_v, n + 1), whitened, leave least; None where none leaves little."""
    W, n_v, n = len(rows), rows.shape[1], rows.shape[2] - 1
    # Windows that overlap may hold the same jump.
    step = max(1, W // TIMES)
    gap = HOPS + step
    edges = list(range(0, W, step))
    before = _reduced([rows[edge : edge + step] for edge in edges])
    behind = _reduced([rows[max(0, W - edge - step) : W - edge] for edge in edges])
    best, out = LEFT, None
    for k in range(len(edges)):
        first = (k + 1) * step
        j = (W - first - gap) // step - 1
        last = W - (j + 1) * step
        sizes = first * n_v, (W - last) * n_v
        if j < 0 or min(sizes) < ROWS_EACH * n:
            continue
        left = float(before[k][-1, -1] ** 2 + behind[j][-1, -1] ** 2)
        together = float(_factor(np.concatenate((before[k], behind[j])))[-1, -1] ** 2)
        freedom = sum(sizes) - 2 * n
        share = max(0.0, left - freedom) / max(together - freedom - n, np.finfo(np.float64).tiny)
        if share <= best:
            at = first + _turn(rows[first:last], before[k], behind[j])
            best, out = share, _Split(first, last, at, together - left, left / freedom)
    return out


def _turn(rows: Array, before: Array, behind: Array) -> int:
    """From which of some windows [A b] (W, n_v, n + 1) on the fit with factor `behind` leaves less than `before`."""
    squares = []
    for factor in (before, behind):
        solution = least_squares(factor[:, :-1], factor[:, -1])
        squares.append(np.sum((rows[..., -1] - rows[..., :-1] @ solution) ** 2, axis=1))
    return int(np.argmin(np.append(0.0, np.cumsum(squares[0] - squares[1]))))


def _reduced(chunks: Sequence[Array]) -> list[Array]:
    """Triangular factors (n + 1, n + 1) of the first chunk, the first two, and so on."""
    n = chunks[0].shape[2]
    out = [np.zeros((n, n))]
    for chunk in chunks:
        out.append(_factor(np.concatenate((out[-1], chunk.reshape(-1, n)))))
    return out[1:]


def _factor(rows: Array) -> Array:
    return np.asarray(np.linalg.qr(rows, mode="r"))
