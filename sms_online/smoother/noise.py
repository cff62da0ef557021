"""The noise of the samples of a span: as stated, or as they show it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.model.model import Model
from sms_online.pipeline.noise import noise_std
from sms_online.pipeline.sensing import Sensing, stated_noise
from sms_online.pipeline.sensor_noise import FEWEST_SAMPLES, SAMPLES
from sms_online.smoother.gatherer import Gatherer
from sms_online.state import Stage, State
from sms_online.stream import Array

# Readings that scatter by this multiple of their stated noise hold more than that: a tenth more and no fit is taken.
NOISIER = 1.05
# No channel is better than this share of its largest reading: the collocation errs by as much.
FINEST = 1e-6


class SpanNoiseState(State):
    """What spans so far have shown.

    sigma (channels,): of the last span's readings, NaN where it is not known. noisier: channels whose samples show more
    noise than is stated, and how many times as much.
    """

    sigma: Array
    noisier: tuple[tuple[str, float], ...] = ()


class SpanNoise(Stage):
    """Noise of the readings of a session, and of its torques. channels: of the readings."""

    def __init__(self, model: Model, sensing: Sensing, channels: Sequence[str]) -> None:
        self._sensing, self._channels = sensing, tuple(channels)
        self._drives, self._rate = slice(model.layout.n_x, None), model.system.sample_rate
        self._stated = stated_noise(model.system, self._channels)
        self.state = SpanNoiseState(np.full(len(self._channels), np.nan))

    def __call__(self, gathered: Gatherer, count: int, goes_on: bool) -> tuple[Array, Array]:
        """Noise of readings (channels,), 1σ a sample, NaN where it is not known; σ² T_s of the torques (joints,).

        Of the first `count` torques gathered. goes_on: from a span before, so that it is short.
        """
        times = dict(self.state.noisier)
        _, torque = gathered.torques(count)
        _, _, t, values = gathered.span(count)
        sigma = self._stated * [times.get(name, 1.0) for name in self._channels]
        if goes_on:
            # A short span has too few samples of a slow channel.
            sigma = np.where(np.isnan(sigma), self.state.sigma, sigma)
        for k in np.flatnonzero(np.isnan(sigma)):
            own = np.flatnonzero(np.isfinite(values[:, k]))[-SAMPLES:]
            if own.size >= FEWEST_SAMPLES:
                sigma[k] = noise_std(values[own, k][:, None], t[own])[0]
        self.state.sigma = sigma
        largest = np.max(np.abs(values), axis=0, initial=0.0, where=np.isfinite(values))
        sigma = np.maximum(sigma, FINEST * largest + np.finfo(np.float64).tiny)
        drives = self._sensing.noise[self._drives]
        silent = np.isnan(drives)
        drives[silent] = noise_std(torque[-SAMPLES:, silent])
        drives = np.maximum(drives, FINEST * np.abs(torque).max(axis=0) + np.finfo(np.float64).tiny)
        return sigma, drives**2 * np.fmax(gathered.periods, 1.0 / self._rate)

    def shows_more(self, gathered: Gatherer, count: int) -> bool:
        """Whether the first `count` torques' samples show more noise than is taken so far; then that is taken."""
        found, (_, _, t, values) = dict(self.state.noisier), gathered.span(count)
        for k in np.flatnonzero(np.isfinite(self._stated)):
            name, own = self._channels[k], np.flatnonzero(np.isfinite(values[:, k]))[-SAMPLES:]
            if own.size >= FEWEST_SAMPLES:
                shown = float(noise_std(values[own, k][:, None], t[own])[0] / self._stated[k])
                if shown > NOISIER * found.get(name, 1.0):
                    found[name] = shown
        before, self.state.noisier = self.state.noisier, tuple(found.items())
        return self.state.noisier != before
