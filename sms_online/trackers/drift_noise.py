"""How freely the rate of a drift walks, and how fast it decays: what its innovations are likeliest under."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sms_online.trackers.drift_filter import DriftFilter, Moving

# Times in which a rate changes by its own size, s: what process noise is chosen from, none the first; and in which it
# decays, for what warms up, runs in or empties approaches an end.
TIMES = (np.inf, 1e4, 1000.0, 300.0, 100.0, 30.0, 10.0, 3.0)
DECAYS = (np.inf, 300.0, 100.0, 50.0, 30.0, 20.0, 10.0)
# What process noise or decay must gain in twice the log likelihood of the innovations over none.
COST = 4.0


def likeliest(
    moving: Sequence[Moving], filtered: Callable[[Sequence[Moving]], tuple[DriftFilter, float]]
) -> tuple[list[Moving], DriftFilter]:
    """What moves, with the process noise and decay of each that was learned, and the filter of it.

    filtered: gives the filter of what moves, and minus twice the log likelihood of its innovations.
    """
    best, (chosen, least) = list(moving), filtered(moving)
    least += _cost(moving)
    for k in range(len(best)):
        # What decays steadily looks like process noise, so every decay is tried with the least of that first.
        tried = [(_least_level(fading), fading) for fading in range(len(DECAYS))]
        while best[k].learned:
            before = best[k]
            for level, fading in [*tried, *_around(before)]:
                other = [*best[:k], before.at(level, TIMES[level], fading, DECAYS[fading]), *best[k + 1 :]]
                found, loss = filtered(other)
                loss += _cost(other)
                if loss < least:
                    chosen, least, best = found, loss, other
            if best[k] == before:
                break
            tried = []
    return best, chosen


def _least_level(fading: int) -> int:
    """Process noise of a decay at least: that of the drift lies between two of them."""
    return min(fading, 1)


def _around(each: Moving) -> list[tuple[int, int]]:
    """Process noise and decays beside those of a drift."""
    level, fading = each.level, each.fading
    beside = [(level - 1, fading), (level + 1, fading), (level, fading - 1), (level, fading + 1)]
    return [(q, d) for q, d in beside if 0 <= d < len(DECAYS) and _least_level(d) <= q < len(TIMES)]


def _cost(moving: Sequence[Moving]) -> float:
    """What process noise and decay must gain over none."""
    return COST * sum((each.level > _least_level(each.fading)) + (each.fading > 0) for each in moving)
