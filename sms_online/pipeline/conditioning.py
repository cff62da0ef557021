"""Declared effects on channels and latencies of sensors, subtracted from the grid samples before anything else.

Offsets and eccentricities are functions of a sample; lags and delays ask for samples on both sides, so that every
channel is passed on as much later, and what lies so close to a gap is lost.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.description.schema import System
from sms_online.effects.catalogue import corrections
from sms_online.effects.channel import Convolved
from sms_online.pipeline.convolution import Convolution
from sms_online.stream import Array


def channel_kernels(system: System, channels: Sequence[str]) -> dict[int, Array]:
    """Weights of the samples on both sides that take lags and delays off, by the channel's number."""
    kernels: dict[int, Array] = {}
    for effect in corrections(system):
        for k, channel in enumerate(channels):
            if isinstance(effect, Convolved) and effect.acts_on(channel):
                # One after the other is one by both.
                kernel = effect.kernel(system.sample_rate)
                kernels[k] = np.convolve(kernels[k], kernel) if k in kernels else kernel
    return kernels


def noise_gains(system: System, channels: Sequence[str]) -> Array:
    """By how much more white noise a corrected sample of each channel has, 1 at least (channels,), than one as read.

    What takes a lag off lets slow noise pass as it is and enlarges that near its corner. Limitation: of all frequencies
    together; a filter behind it hears more of a lag of some 5 to 50 Hz, and less of a quicker one.
    """
    gains = np.ones(len(channels))
    for k, kernel in channel_kernels(system, channels).items():
        gains[k] = max(1.0, float(np.linalg.norm(kernel)))
    return gains


class Conditioning(Convolution):
    """Corrects the channels of one session by the constants that its system file states.

    Lags and delays come off first, for they act on what the sensor reads. InputError as `channel_effects`.
    """

    def __init__(self, system: System, channels: tuple[str, ...]) -> None:
        self._sample_rate = system.sample_rate
        effects = [(k, e) for e in corrections(system) for k, channel in enumerate(channels) if e.acts_on(channel)]
        self._of_value = [(k, effect) for k, effect in effects if not isinstance(effect, Convolved)]
        super().__init__(channel_kernels(system, channels))

    def _correct(self, values: Array) -> None:
        for column, effect in reversed(self._of_value):
            values[:, column] = effect.correct(values[:, column], self._sample_rate)
