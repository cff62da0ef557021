"""Effects that become constants of the description when they are found, and are no unknowns of π.

Effects on channels are subtracted from the samples. A tilted table is gravity, whose product with the masses is not
linear in both. Their columns are first-order approximations: constants are improved by fitting the corrected samples.
"""

from __future__ import annotations

from collections.abc import Sequence

from sms_online.description.schema import Effect, System
from sms_online.diagnosis.record import Segment
from sms_online.effects.catalogue import CONSTANTS, corrections
from sms_online.effects.channel import Convolved
from sms_online.stream import Array


def is_constant(effect: Effect) -> bool:
    """Whether an effect becomes a constant."""
    return effect.name in CONSTANTS


def improved(effect: Effect, increments: Array) -> Effect:
    """An effect with its constants changed by linear coefficients that are fitted to the corrected samples."""
    changed = CONSTANTS[effect.name].improved(effect.coefficients, increments)
    return effect.model_copy(update={"coefficients": changed})


def possible(effect: Effect, sample_rate: float) -> bool:
    """Whether constants that were improved are still of an effect, on samples at so many Hz."""
    return CONSTANTS[effect.name].possible(effect.coefficients, sample_rate)


def deviations(effect: Effect, covariance: Array) -> dict[str, float]:
    """1σ of the constants for the covariance (c, c) of the linear coefficients."""
    return CONSTANTS[effect.name].deviations(effect.coefficients, covariance)


def corrected(system: System, channels: Sequence[str], segment: Segment) -> Segment:
    """Samples of the channels without what the system says to take off, the last of which was the first."""
    values = segment.values.copy()
    # A sensor's lag acts on what its disc or its zero has already distorted.
    last_first = corrections(system)[::-1]
    for effect in sorted(last_first, key=lambda effect: not isinstance(effect, Convolved)):
        for k, channel in enumerate(channels):
            if effect.acts_on(channel):
                values[:, k] = effect.correct(values[:, k], system.sample_rate)
    return Segment(segment.index, values)
