"""Whether the rates of a drift have changed: what has a beginning may end.

A learned drift goes on at its rate, with as little process noise as its rows ask for, and would go on so for long after
it has ended or turned. So at each knot another filter branches off, for each drift, in which its rates have changed by
their own size in the second before. All take in the same rows; where the innovations of one are so much likelier that
a change is likelier than none, it is gone on with.
Source: Adams and MacKay, Bayesian Online Changepoint Detection, arXiv:0710.3742; here one change at a time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sms_online.trackers.drift_filter import Block, DriftFilter, innovation_loss

# Knots from one change of a drift's rates to the next, as expected beforehand, and knots for which a change is tried.
EXPECTED, TRIED = 60.0, 6


@dataclass(frozen=True)
class RateChange:
    """Rates of one drift that may have changed at a knot.

    filter: at the newest step, if they have. gain: by how much twice the log likelihood of the rows since is larger.
    """

    knot: int
    filter: DriftFilter
    gain: float = 0.0

    @property
    def likelier(self) -> float:
        """Logarithm of its odds against no change."""
        return 0.5 * self.gain - float(np.log(EXPECTED))

    def absorbed(self, block: Block, loss: float) -> RateChange:
        """With a block's rows; loss: that of the filter without a change."""
        after = self.filter.absorbed(block)
        return replace(self, filter=after, gain=self.gain + loss - innovation_loss(self.filter, after))

    def advanced(self, step: int) -> RateChange:
        """At a later step."""
        return replace(self, filter=self.filter.advanced(step))


def branches(state: DriftFilter, knot: int) -> list[RateChange]:
    """A change of each learned drift's rates at a knot; state: before it is advanced there."""
    return [
        RateChange(knot, replace(state, moving=(*state.moving[:k], each.bent(knot), *state.moving[k + 1 :])))
        for k, each in enumerate(state.moving)
        if each.learned and each.since <= state.knot
    ]
