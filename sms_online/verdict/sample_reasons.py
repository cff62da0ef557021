"""The reasons to doubt the samples behind an estimate: what is lost, late, an outlier or silent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sms_online.verdict.evidence import Evidence
from sms_online.verdict.reasons import CHECK_COLOUR, listed
from sms_online.verdict.trust import Reason

# Share of the samples that may be lost before the rest is no fair part of the motion.
LARGEST_LOSS = 0.01
# Share of a channel's samples that may be outliers before its sensor is at fault.
MANY_OUTLIERS = 1e-3
# Jitter, s, from which on it is said: below, devices' own clocks are no better.
LARGEST_JITTER = 5e-5
# Correlation time of noise, s, from which on windows share it, while they are whitened as if they did not.
LONGEST_COLOUR = 1e-2
# What to do next.
CHECK_OUTLIERS = "look at that sensor: reflections and swapped markers, a loose cable, bits that flip"
CHECK_STAMPS = "stamp samples where they are taken, by the device's clock or its count, not where they arrive"
BY_SMOOTHER = 'state its rate under [[sensor]], or balance = "smoother"'
CHECK_LOSSES = "look at the faults that the session counted: a bus that is too busy, a loose cable"
CHECK_DEVICE = "look at power, cable and address of what is silent, and at its table in the system file"
CHECK_TROUBLE = "mend the device, the recording or the machine that is reported first"


def of_samples(evidence: Evidence) -> list[Reason]:
    """Faults of the samples: loss, many outliers, low rates, jitter and coloured noise."""
    out = [*_lost(evidence.lost), *outliers(evidence.outliers, few=False), *_slow(evidence.slow)]
    return [*out, *_jittering(evidence.jitters), *_coloured(evidence.coloured)]


def _lost(share: float) -> list[Reason]:
    if share <= LARGEST_LOSS:
        return []
    return [Reason(f"{100.0 * share:.0f} % of the samples are lost", False, then=CHECK_LOSSES)]


def _largest(values: Mapping[str, float]) -> tuple[str, float]:
    """The channel with the largest value in words, with how many more there are, and that value."""
    worst = max(values, key=lambda channel: values[channel])
    return worst + (f" and of {len(values) - 1} more channels" if len(values) > 1 else ""), values[worst]


def outliers(shares: Mapping[str, float], few: bool) -> list[Reason]:
    """Outliers, left out; few: those so few that no estimate is wrong by what the other samples have of them."""
    many = {channel: share for channel, share in shares.items() if share > MANY_OUTLIERS}
    if not many or few != (max(many.values()) <= LARGEST_LOSS):
        return []
    of, worst = _largest(many)
    text = f"{100.0 * worst:.1g} % of the samples of {of} are outliers, left out"
    return [Reason(text, False, tuple(many), "outliers", then=CHECK_OUTLIERS)]


def _slow(rates: Mapping[str, float]) -> list[Reason]:
    if not rates:
        return []
    text = f"{listed([*rates])}: {min(rates.values()):.3g} samples/s are too few for the windows of the balance"
    return [Reason(text, False, (), "slow", then=BY_SMOOTHER)]


def _jittering(jitters: Mapping[str, float]) -> list[Reason]:
    return [
        Reason(f"stamps of {device} jitter by {1e3 * std:.2g} ms", False, (), "stamps jitter", then=CHECK_STAMPS)
        for device, std in jitters.items()
        if std > LARGEST_JITTER
    ]


def _coloured(times: Mapping[str, float]) -> list[Reason]:
    slow = {channel: time for channel, time in times.items() if time > LONGEST_COLOUR}
    if not slow:
        return []
    of, worst = _largest(slow)
    text = f"noise of {of} is correlated over {1e3 * worst:.2g} ms"
    return [Reason(text, False, tuple(slow), "coloured noise", then=CHECK_COLOUR)]


def never_received(names: Sequence[str]) -> Reason:
    """Sources or channels that have never delivered anything."""
    return Reason(f"nothing was received of {listed(names)}", False, then=CHECK_DEVICE)


def silenced(since: Mapping[str, float]) -> list[Reason]:
    """Sources or channels that deliver nothing any more; since: s."""
    if not since:
        return []
    text = f"nothing has come of {listed([*since])} since {min(since.values()):.1f} s"
    return [Reason(text, False, then=CHECK_DEVICE)]


def troubled(troubles: Sequence[str]) -> list[Reason]:
    """What keeps samples from coming."""
    return [Reason(trouble, False, then=CHECK_TROUBLE) for trouble in troubles]
