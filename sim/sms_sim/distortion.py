"""What declared effects on channels make of exact values, before the sensors' own noise."""

from __future__ import annotations

import numpy as np
import scipy.signal

from sms_online.description.schema import System
from sms_online.effects.catalogue import channel_effects
from sms_online.effects.channel import Convolved
from sms_online.stream import Array

# A lag is integrated on so many exact values a sample, joined by straight lines: at 1 kHz and 10 rad/s² they are off by
# 2e-8 rad, far below any sensor's noise.
OVERSAMPLING = 8


class Distortion:
    """Effects that a system declares on `channels` (C names): those of a value alone first, then lags.

    A torque's delay is none of these, but a latency of its sensor.

    oversampling: exact values that a sample asks for, ending with its own; 1 where no channel lags, or where `single`
    says that there are no others. Values have to come in order of time.
    """

    def __init__(self, system: System, channels: tuple[str, ...], single: bool = False) -> None:
        effects = [(k, e) for e in channel_effects(system) for k, channel in enumerate(channels) if e.acts_on(channel)]
        self._of_value = [(k, effect) for k, effect in effects if not isinstance(effect, Convolved)]
        lags = [(k, effect) for k, effect in effects if effect.filtered]
        self.oversampling = OVERSAMPLING if lags and not single else 1
        rate = self.oversampling * system.sample_rate
        self._sample_rate = system.sample_rate
        self._lags = [(k, *effect.filter(rate)) for k, effect in lags]
        self._states: list[Array] | None = None  # of the lags' filters

    def __call__(self, exact: Array) -> Array:
        """Values (B, C) at samples, of exact values (M, C) that follow those before; the first of all at rest."""
        values = exact.copy()
        for column, effect in self._of_value:
            values[:, column] = effect.distort(values[:, column], self._sample_rate)
        if self._states is None:
            self._states = [scipy.signal.lfilter_zi(b, a) * values[0, column] for column, b, a in self._lags]
        for k, (column, b, a) in enumerate(self._lags):
            values[:, column], self._states[k] = scipy.signal.lfilter(b, a, values[:, column], zi=self._states[k])
        return np.asarray(values[(values.shape[0] - 1) % self.oversampling :: self.oversampling])
