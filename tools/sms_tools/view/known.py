"""What is known of the parameters at an instant, as plots, tables and the log take it."""

from __future__ import annotations

from dataclasses import dataclass

from sms_online.stream import Array, Mask

# Error bars and bands are drawn so far to either side, in standard deviations.
BOUNDS = 2.0


@dataclass(frozen=True)
class Known:
    """Estimate (n,) and standard deviation (n,), inf where the data determine nothing, at t, s.

    determined: what the data determine (n,).
    """

    t: float
    estimate: Array
    std: Array
    determined: Mask
