"""What the sensors of a testbed make of exact values: rate, latency, white noise, resolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_online.description.channels import drive_channels, sensed_channels, wrench_channels
from sms_online.description.schema import Sensor, System
from sms_online.effects.catalogue import channel_effects
from sms_online.errors import InputError
from sms_online.pipeline.sensing import EULER_PARAMETERS
from sms_online.stream import Array


@dataclass(frozen=True)
class Grade:
    """White noise of a sample, 1σ.

    encoder: of encoders and the base's angle, rad. marker: of markers and the base's position, m (slopes rad).
    torque: of n τ and of measured wrenches, N and N m.
    """

    encoder: float
    marker: float
    torque: float


# Noise grades of a session, from a good testbed's (A) to a plain one's (C), at 1 kHz.
GRADES = {
    "0": Grade(encoder=0.0, marker=0.0, torque=0.0),
    "A": Grade(encoder=1e-5, marker=1e-5, torque=0.1),
    "B": Grade(encoder=1e-4, marker=1e-4, torque=0.5),
    "C": Grade(encoder=1e-4, marker=1e-3, torque=0.5),
}
ENCODERS = ("q_", "theta_m_", "theta_0")


class Sensors:
    """The sensors on `channels` (C names), as described, or all of them at the system's rate with the noise of a grade.

    measurable: channels that exact values exist for, drives first. Those that no sensor fills are left out; drives are
    always there, for the torque is commanded, and so are measured wrenches; a system without sensors has them all,
    exact. Raises InputError on an unknown grade.
    """

    def __init__(self, system: System, measurable: tuple[str, ...], grade: str | None, seed: int) -> None:
        if grade is not None and grade not in GRADES:
            raise InputError("simulation", "grade", repr(grade), f"one of {', '.join(GRADES)}")
        drives = drive_channels(system)
        inputs = (*drives, *wrench_channels(system))
        filled = {channel: sensor for sensor in system.sensors for channel in sensed_channels(system, sensor)}
        self.channels = tuple(c for c in measurable if c in inputs or not system.sensors or c in filled)
        ideal = Sensor(channels=("*",))
        if grade is None:
            used = [filled.get(channel, ideal) for channel in self.channels]
        else:
            used = [Sensor(channels=(c,), noise=_grade_noise(system, c, drives, GRADES[grade])) for c in self.channels]
        self.sample_rate = system.sample_rate
        self.latency = np.array([sensor.delay(system.sample_rate) for sensor in used]) + _latencies(
            system, self.channels
        )
        self.rate = np.array([min(sensor.rate or self.sample_rate, self.sample_rate) for sensor in used])
        self.noise = np.array([sensor.noise for sensor in used])
        self.resolution = np.array([sensor.resolution for sensor in used])
        self._random = np.random.default_rng(seed)

    def read(self, first: int, exact: Array) -> Array:
        """Readings (B, C) of exact values (B, C) at samples first, first + 1, … of the system's rate; NaN is no sample.

        A sensor slower than the system fills the first sample of each of its own intervals. Samples have to be read in
        order: noise is drawn for every channel of every sample, so that it depends on the seed alone.
        """
        values = exact + self.noise * self._random.standard_normal(exact.shape)
        step = np.where(self.resolution > 0.0, self.resolution, 1.0)
        values = np.where(self.resolution > 0.0, step * np.round(values / step), values)
        # The sensor's own interval that each sample, and the one before it, falls into; rounding must not split one.
        samples = first + np.arange(-1, exact.shape[0])
        interval = np.floor(samples[:, None] * (self.rate / self.sample_rate) + 1e-9)
        return np.where(np.diff(interval, axis=0) > 0, values, np.nan)


def _latencies(system: System, channels: tuple[str, ...]) -> Array:
    """Delays (channels,) that effects state, s."""
    out = np.zeros(len(channels))
    for effect in channel_effects(system):
        out += [effect.latency * effect.acts_on(channel) for channel in channels]
    return out


def _grade_noise(system: System, channel: str, drives: dict[str, int], grade: Grade) -> float:
    """σ of a channel in its own unit."""
    if channel in drives:
        gear = system.joints[drives[channel] - 1].gear_ratio
        return grade.torque / gear if channel.startswith("tau_") else grade.torque
    if channel.startswith("wrench_"):
        return grade.torque
    if channel in EULER_PARAMETERS:
        # Euler parameters turn by half the angle.
        return 0.5 * grade.encoder
    return grade.encoder if channel.startswith(ENCODERS) else grade.marker
