"""Noise of the sensors as the balances need it: stated in the system file, or estimated from a channel's samples."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec
import numpy as np

from sms_online.description.schema import System
from sms_online.grouping import grouped
from sms_online.pipeline.clocks import other_clocks, reference_clock
from sms_online.pipeline.conditioning import noise_gains
from sms_online.pipeline.noise import correlation, density_gain, noise_std
from sms_online.pipeline.sensing import EULER_PARAMETERS, Sensing
from sms_online.pipeline.stamp_jitter import (
    Jitter,
    JitterState,
    by_sensor,
    jitters,
    left_and_rates,
    noise_beside,
    pair_sums,
)
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices, Mask

# A channel's last samples that an estimate takes: 2 % scatter.
SAMPLES = 4000
# Fewer give no estimate.
FEWEST_SAMPLES = 100
# Estimates of a channel's colour that its mean is over at most; and after which it counts where samples show none.
MOST_COLOURS, SURE_COLOURS = 16.0, 3.0
# Density over that of before from which on rows are made again.
LOUDER = 2.0
# No sensor is better than this share of its largest reading: what is left is rounding, and interpolation between the
# samples.
FINEST = 1e-10
# Positions whose noise is within this of the finest are exact: what products make of it is below rounding.
ROUGHLY_EXACT = 100.0


@dataclass(frozen=True)
class SensorNoise:
    """Noise of position sensors and measured inputs.

    sensors (n_x,), torque (inputs,): densities σ² T_s of each position sensor, in the order of the coordinates, of n τ
    and of measured wrenches. coordinates (n_x,): 1σ of the coordinates x a grid sample, had they white noise of those
    densities, and what taking lags off adds. grid (n_x + drives,): the same of the readings of position sensors and of
    torques. exact: positions have none, but for rounding. coloured: correlation time, s, of channels whose noise is not
    white; their density is that in the pass band of the windows. slow (n_x,): where that was seen several times.
    jitters: of devices' stamps. lateness (n_x,): 1σ of a grid sample's by them, s.
    """

    sensors: Array
    torque: Array
    coordinates: Array
    grid: Array
    exact: bool
    slow: Mask
    coloured: dict[str, float] = field(default_factory=dict)
    jitters: tuple[Jitter, ...] = ()
    lateness: Array | None = None

    def outdates(self, before: SensorNoise) -> bool:
        """Whether rows made with a noise of before were made without a jitter, or with far less of a slow noise."""
        louder = self.slow & (self.sensors > LOUDER * before.sensors)
        return bool(louder.any()) or bool(self.jitters and not before.jitters)


class NoiseEstimateState(State):
    """What is kept of the channels' samples.

    samples: instants and values (2, ·) of each channel's last ones. largest (channels,): reading of each. jitter: sums
    for that of stamps. colour (channels, 3): how often one was found; means of the gain in density that it is, and of
    the inverse of its correlation time, 1/s. fresh: instants and values that no channel has yet; unsorted: how many.
    """

    samples: list[Array]
    largest: Array
    jitter: JitterState
    colour: Array
    fresh: list[tuple[Array, Array]] = msgspec.field(default_factory=list)
    unsorted: int = 0


class NoiseEstimate(Stage):
    """Collects each channel's own samples, which are not interpolated, and estimates the noise of all.

    sample_rate: of the grid, Hz. pass_band: frequency that the windows let pass best, Hz.
    """

    def __init__(self, sensing: Sensing, sample_rate: float, pass_band: float) -> None:
        self._sensing, self._pass_band = sensing, pass_band
        self._sample_rate = sample_rate
        count = len(sensing.channels)
        reference = reference_clock(sensing)
        own = [] if reference is None else [(reference.name, list(reference.sensors))]
        self._devices = [*own, *((name, sensors) for (name, _), sensors in other_clocks(sensing).items())]
        jitter = JitterState.none(len(sensing.position_columns))
        self.state = NoiseEstimateState(
            [np.empty((2, 0)) for _ in range(count)], np.zeros(count), jitter, np.zeros((count, 3))
        )

    def push(self, t: Array, values: Array) -> None:
        """Take samples (B, channels) at instants t (B,), NaN where a channel has none."""
        self.state.fresh.append((t, values))
        self.state.unsorted += t.size
        if self.state.unsorted >= SAMPLES:
            self._sort()

    def _sort(self) -> None:
        """Give each channel the samples that came since the noise was asked for last."""
        if not self.state.fresh:
            return
        t = np.concatenate([t for t, _ in self.state.fresh])
        values = np.concatenate([values for _, values in self.state.fresh])
        self.state.fresh, self.state.unsorted = [], 0
        self.state.largest = self.state.largest.copy()
        for k, column in enumerate(values.T):
            fresh = np.stack((t, column))[:, np.isfinite(column)]
            last = self.state.samples[k][0, -1:] if self.state.samples[k].size else -np.inf
            fresh = fresh[:, np.diff(fresh[0], prepend=last) > 0.0]  # duplicates hold no information
            self.state.largest[k] = max(self.state.largest[k], np.abs(fresh[1]).max(initial=0.0))
            self.state.samples[k] = np.concatenate((self.state.samples[k], fresh), axis=1)[:, -SAMPLES:]

    @property
    def ready(self) -> bool:
        """Whether every channel has samples enough."""
        self._sort()
        return all(kept.shape[1] >= FEWEST_SAMPLES for kept in self.state.samples)

    def _sampled_together(self, channels: list[int]) -> list[list[int]]:
        """Some channels, those with samples at the same instants together."""
        return list(grouped((self.state.samples[k][0].tobytes(), k) for k in channels).values())

    def noise(self, periods: Array, system: System) -> SensorNoise:
        """Noise from what is stated and, where nothing is, from the samples so far.

        periods (channels,): s, or NaN. system: whose corrections samples have.
        """
        self._sort()
        sigma = self._sensing.stated_noise
        silent = np.flatnonzero(np.isnan(sigma))
        period = np.maximum(np.where(np.isnan(periods), 0.0, periods), 1.0 / self._sample_rate)
        for together in self._sampled_together(silent.tolist()):
            samples = np.stack([self.state.samples[k][1] for k in together], axis=1)
            sigma[together] = noise_std(samples, self.state.samples[together[0]][0])
        whole = sigma.copy()
        found = self._jitters(sigma, silent, period)
        floor = FINEST * self.state.largest + np.finfo(np.float64).tiny
        positions = self._sensing.position_columns
        exact = bool(np.all(sigma[positions] <= ROUGHLY_EXACT * floor[positions]))
        density = np.maximum(sigma, floor) ** 2 * period
        coloured: dict[str, float] = {}
        for k in np.intersect1d(silent, positions).tolist() if not exact else ():
            colour = self._colour(k, correlation(self.state.samples[k][1], whole[k]), float(period[k]))
            if colour is not None:
                gain, coloured[self._sensing.channels[k]] = colour
                density[k] *= gain
        sensors = density[positions]
        inputs = self._sensing.inputs(np.sqrt(density)[None])[0] ** 2
        columns = [*positions, *self._sensing.torque_columns]
        gains = noise_gains(system, self._sensing.channels)
        grid = (gains * np.sqrt(density * self._sample_rate))[columns]
        coordinates = self._sensing.coordinate_noise(grid[: len(positions)])
        late = by_sensor(found, len(positions), self._sample_rate) if found else None
        # A signal may look like slow noise for a second.
        slow = self.state.colour[positions, 0] >= SURE_COLOURS
        return SensorNoise(sensors, inputs, coordinates, grid, exact, slow, coloured, found, late)

    def _colour(self, channel: int, correlated: float, period: float) -> tuple[float, float] | None:
        """Density in the pass band over that at high frequencies, and correlation time, s, of a channel's noise.

        Each is a mean over time of what samples say: those of some seconds hold few slow errors. correlated: what the
        last ones say, 0 where nothing. None where the noise is white.
        """
        count, gain, rate = self.state.colour[channel].tolist()
        if correlated > 0.0:
            count = min(count + 1.0, MOST_COLOURS)
            gain += (density_gain(correlated, self._pass_band * period) - gain) / count
            rate += (-float(np.log(correlated)) / period - rate) / count
            self.state.colour = self.state.colour.copy()
            self.state.colour[channel] = count, gain, rate
        return (gain, 1.0 / rate) if correlated > 0.0 or count >= SURE_COLOURS else None

    def _jitters(self, sigma: Array, silent: Indices, period: Array) -> tuple[Jitter, ...]:
        """Jitters of the devices' stamps; noise (channels,) of silent channels becomes what is beside them."""
        positions = np.array(self._sensing.position_columns)
        parts: dict[int, tuple[Array, Array]] = {}
        for together in self._sampled_together(positions.tolist()):
            samples = np.stack([self.state.samples[k][1] for k in together], axis=1)
            left, rates = left_and_rates(samples, self.state.samples[together[0]][0])
            own = np.flatnonzero(np.isin(positions, together))
            quaternion = np.isin([self._sensing.channels[k] for k in together], EULER_PARAMETERS)
            self.state.jitter = self.state.jitter.with_sums(*pair_sums(left, rates, quaternion), own)
            parts |= {k: (left[:, c], rates[:, c]) for c, k in enumerate(together)}
        found = jitters(self.state.jitter, self._devices, period[positions])
        for jitter in found:
            for k in np.intersect1d(positions[list(jitter.sensors)], silent).tolist():
                sigma[k] = noise_beside(*parts[k], jitter.std)
        return found
