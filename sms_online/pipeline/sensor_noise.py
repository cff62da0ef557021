"""Noise of the sensors as the balances need it: stated in the system file, or estimated from a channel's samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_online.pipeline.conditioning import noise_gains
from sms_online.pipeline.noise import noise_std
from sms_online.pipeline.sensing import Sensing
from sms_online.stream import Array

# A channel's last samples that an estimate takes: 2 % scatter.
SAMPLES = 4000
# Fewer give no estimate.
FEWEST_SAMPLES = 100
# No sensor is better than this share of its largest reading: what is left is rounding, and interpolation between the
# samples.
FINEST = 1e-10
# Positions whose noise is within this of the finest are exact: what products make of it is below rounding.
ROUGHLY_EXACT = 100.0


@dataclass(frozen=True)
class SensorNoise:
    """Noise of position sensors and joint torques.

    sensors (n_x,), torque (joints,): densities σ² T_s of each position sensor, in the order of the coordinates, and of
    n τ. coordinates (n_x,): 1σ of the coordinates x a grid sample, had they white noise of those densities, and what
    taking lags off adds. grid (n_x + joints,): the same of the readings of position sensors and of torques. exact:
    positions have none, but for rounding.
    """

    sensors: Array
    torque: Array
    coordinates: Array
    grid: Array
    exact: bool


NOISE_ARRAYS = ("sensors", "torque", "coordinates", "grid")


def noise_state(name: str, noise: SensorNoise | None) -> dict[str, Any]:
    """A noise as arrays, to be saved under names that begin with `name`."""
    if noise is None:
        return {f"{name}_known": False}
    return {f"{name}_known": True} | {f"{name}_{part}": getattr(noise, part) for part in (*NOISE_ARRAYS, "exact")}


def noise_from_state(name: str, state: Mapping[str, NDArray[Any]]) -> SensorNoise | None:
    """The noise that `noise_state` saved."""
    if not bool(state[f"{name}_known"]):
        return None
    sensors, torque, coordinates, grid = (np.array(state[f"{name}_{part}"]) for part in NOISE_ARRAYS)
    return SensorNoise(sensors, torque, coordinates, grid, bool(state[f"{name}_exact"]))


class NoiseEstimate:
    """Collects each channel's own samples, which are not interpolated, and tells the noise of all.

    sample_rate: of the grid, Hz.
    """

    def __init__(self, sensing: Sensing, sample_rate: float) -> None:
        self._sensing = sensing
        self._sample_rate = sample_rate
        count = len(sensing.channels)
        self._samples = [np.empty((2, 0)) for _ in range(count)]  # instants and values
        self._largest = np.zeros(count)
        self._fresh: list[tuple[Array, Array]] = []  # instants and values that no channel has yet
        self._unsorted = 0  # how many

    def push(self, t: Array, values: Array) -> None:
        """Take samples (B, channels) at instants t (B,), NaN where a channel has none."""
        self._fresh.append((t, values))
        self._unsorted += t.size
        if self._unsorted >= SAMPLES:
            self._sort()

    def _sort(self) -> None:
        """Give each channel the samples that came since the noise was asked for last."""
        if not self._fresh:
            return
        t = np.concatenate([t for t, _ in self._fresh])
        values = np.concatenate([values for _, values in self._fresh])
        self._fresh, self._unsorted = [], 0
        for k, column in enumerate(values.T):
            fresh = np.stack((t, column))[:, np.isfinite(column)]
            last = self._samples[k][0, -1:] if self._samples[k].size else -np.inf
            fresh = fresh[:, np.diff(fresh[0], prepend=last) > 0.0]  # duplicates tell nothing
            self._largest[k] = max(self._largest[k], np.abs(fresh[1]).max(initial=0.0))
            self._samples[k] = np.concatenate((self._samples[k], fresh), axis=1)[:, -SAMPLES:]

    @property
    def ready(self) -> bool:
        """Whether every channel has samples enough."""
        self._sort()
        return all(kept.shape[1] >= FEWEST_SAMPLES for kept in self._samples)

    def noise(self, periods: Array) -> SensorNoise:
        """Noise from what is stated and, where nothing is, from the samples so far; periods (channels,): s, or NaN."""
        self._sort()
        sigma = self._sensing.stated_noise
        silent = np.flatnonzero(np.isnan(sigma))
        for k in silent:
            times, samples = self._samples[k]
            sigma[k] = noise_std(samples[:, None], times)[0]
        floor = FINEST * self._largest + np.finfo(np.float64).tiny
        positions = self._sensing.position_columns
        exact = bool(np.all(sigma[positions] <= ROUGHLY_EXACT * floor[positions]))
        period = np.maximum(np.where(np.isnan(periods), 0.0, periods), 1.0 / self._sample_rate)
        density = np.maximum(sigma, floor) ** 2 * period
        sensors = density[positions]
        torque = self._sensing.joint_torque(np.sqrt(density)[None])[0] ** 2
        columns = [*positions, *self._sensing.torque_columns]
        gains = noise_gains(self._sensing.model.system, self._sensing.channels)
        grid = (gains * np.sqrt(density * self._sample_rate))[columns]
        coordinates = self._sensing.coordinate_noise(grid[: len(positions)])
        return SensorNoise(sensors, torque, coordinates, grid, exact)

    def state(self) -> dict[str, Any]:
        """What `restore` needs to continue."""
        self._sort()
        sizes = np.array([kept.shape[1] for kept in self._samples])
        return {"samples": np.concatenate(self._samples, axis=1), "sizes": sizes, "largest": self._largest}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a saved state."""
        self._samples = np.split(np.array(state["samples"]), np.cumsum(state["sizes"])[:-1], axis=1)
        self._largest = np.array(state["largest"])
