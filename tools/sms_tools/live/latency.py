"""How old the news is: from the arrival of a sample to an estimate that it is part of."""

from __future__ import annotations

import numpy as np

# Width of a bin, s, and number of bins: up to 4 s, beyond which the last one counts.
BIN, BINS = 1e-3, 4000
# Age at which samples begin to be forgotten, s.
RECENT = 10.0


class Latencies:
    """Distribution of the time from a sample's arrival to the estimate that it is in, the filter's lag included.

    A sample is in the estimate from the first window on that ends at it or after it, whose last samples count little;
    that the window waits for the samples that its filter needs beyond its end counts as latency.

    It forgets: quantiles are of the last RECENT to 2 RECENT s. The start, when samples wait until the filter's width is
    chosen, says nothing of the rest.
    """

    def __init__(self) -> None:
        self._counts = np.zeros((2, BINS), dtype=np.int64)  # of the current and of the last RECENT s
        self._last = np.nan  # time of the newest row before
        self._turned = 0.0

    def add(self, now: float, newest: float) -> None:
        """The estimate of `now` is the first with samples up to `newest`, both s on the session's clock.

        Samples between the newest row before and this one waited for it, the older ones longer. Their way up to
        arrival belongs to the transport and is small; it is counted too.
        """
        if newest == self._last:
            return
        if now - self._turned > RECENT:
            self._turned = now
            self._counts = np.stack((np.zeros(BINS, dtype=np.int64), self._counts[0]))
        if np.isfinite(self._last) and newest - self._last < BINS * BIN:
            ages = now - np.arange(newest, self._last, -BIN)
            np.add.at(self._counts[0], np.clip((ages / BIN).astype(np.int64), 0, BINS - 1), 1)
        self._last = newest

    def quantile(self, share: float) -> float | None:
        """The latency, s, that this share of the samples stays below; None before there is any."""
        counts = self._counts.sum(axis=0)
        if not counts.any():
            return None
        return float((np.searchsorted(np.cumsum(counts), share * counts.sum()) + 1) * BIN)
