"""What a learned trend keeps of its rows, and what it reports of a drift."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from sms_online.state import State
from sms_online.stream import Array
from sms_online.trackers.drift_filter import START, Block, DriftFilter, Moving
from sms_online.trackers.drift_search import Suspicion
from sms_online.trackers.rate_change import RateChange


@dataclass(frozen=True)
class Found:
    """A drift that was learned, of the parameter in `column`, since when, s; its rate now and its deviation, per s.

    changed: instant, s, before which the rate became another one; None where it never did.
    """

    column: int
    since: float
    rate: float
    std: float
    changed: float | None = None


class DriftState(State):
    """What a learned trend keeps of its rows.

    anchor: the filter at the oldest remembered knot; now: at the newest step. blocks: from knot to knot. pending: rows
    [Y, (t - knot) Y, b] since the last knot; fresh: how many of them are not in `now` yet. step: number of the open
    one, START before the first; knots: since the beginning; shown: of these, in pairs, those in which the arm moved, as
    it has since the last pair where `moves`. rows: so far; newest: time of the last, s. accepted: how often drifts
    were. quiet: whether rows leave no more than noise, without which no drift is accepted. lacking: whether they leave
    more in the beginning, which no ramps explain. until: instant that estimates hold for, s; no earlier than that of
    the newest row. likeliest: change that the last search found, of what does not move; suspected: where it is hardly
    chance. changes: of rates, that may have been.
    """

    anchor: DriftFilter
    now: DriftFilter
    moving: list[Moving]
    blocks: list[Block] = msgspec.field(default_factory=list)
    pending: list[Array] = msgspec.field(default_factory=list)
    fresh: int = 0
    step: int = START
    knots: int = 0
    shown: int = 0
    moves: bool = False
    rows: float = 0.0
    newest: float = 0.0
    accepted: int = 0
    quiet: bool = True
    lacking: bool = False
    until: float = -np.inf
    likeliest: Suspicion | None = None
    suspected: Suspicion | None = None
    changes: list[RateChange] = msgspec.field(default_factory=list)
