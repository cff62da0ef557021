"""How many samples pass through the pipeline together."""

from __future__ import annotations

from sms_online.description.schema import System
from sms_online.pipeline import outliers
from sms_online.pipeline.momentum_balance import half_hop, prompt_margin
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.pipeline.synchronise import SIDE

# Samples that pass through the pipeline together are those of some time. Everything behind sees the same blocks however
# the samples arrive, so the result is the same to the last bit. The cost of NumPy's calls is shared by a block, so the
# energy balance alone has long ones, in periods of the grid. With momentum rows a block ends when a window can be
# completed, for whoever waits for an estimate or an event waits for the block too.
ENERGY_BLOCK = 256
# Windows are completed more often than anybody looks: a block is as many hops as there are in this time, s, three of
# the usual windows. With one hop a block, NumPy's calls take most of a session's time.
LEAST_BLOCK = 0.12
# The same where a whole capture is there and nobody waits, s: some twenty hops share the calls.
WHOLE_BLOCK = 1.0
# Of a period of the grid: blocks end between its instants, or rounding would decide to which one a sample belongs.
BETWEEN = 0.5


def blocks(system: System, slowest: float | None, whole: bool = False) -> tuple[float, float]:
    """Duration of the first block, but for whole blocks, and of the others, s.

    slowest: period of the slowest channel, s; None without momentum rows. whole: nobody waits for an estimate.
    With momentum rows a block of whole hops ends with the last sample behind a window, with those that interpolate the
    slowest channel there, and with those that show whether these are outliers.
    """
    if slowest is None:
        return BETWEEN / system.sample_rate, ENERGY_BLOCK / system.sample_rate
    hop = 2 * half_hop(system.sample_rate, system.windows.momentum)
    margin = prompt_margin(hop * HOPS)
    after = SIDE * slowest + min(outliers.SIDE * slowest, outliers.PATIENCE)
    hops = max(1, round((WHOLE_BLOCK if whole else LEAST_BLOCK) * system.sample_rate / hop))
    return (margin % hop + BETWEEN) / system.sample_rate + after, hops * hop / system.sample_rate
