"""What sensors a testbed has, and how much noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.description.channels import drive_channels, wrench_channels
from sms_online.errors import InputError
from sms_online.model.model import Model
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.stream import Array


@dataclass(frozen=True)
class SensorSet:
    """Sensors with white noise.

    channels: what is read, see `Readings`. density (channels,): σ² T_s of each, its unit squared times s. torque
    (inputs,): the same of n τ and of measured wrenches, (N m)² s ((N)² s).
    """

    channels: tuple[str, ...]
    density: Array
    torque: Array


def sensor_set(model: Model, channels: Sequence[str], sigma: Array, rate: Array) -> SensorSet:
    """Sensors on `channels`, drives among them, with noise sigma (channels,), 1σ per sample at rates (channels,), Hz.

    Raises InputError, naming the system, where a drive is not measured or a channel has no noise: a bound needs some.
    """
    system = model.system
    density = sigma**2 / rate
    for name, each in zip(channels, density, strict=True):
        if not each > 0.0:
            place, expected = f"sensor of {name!r}", "noise or resolution above 0, or a grade"
            raise InputError(system.name, place, "no noise is stated", expected)
    torque = np.zeros(model.n_inputs)
    drives = []
    for drive, i in drive_channels(system).items():
        if drive not in channels:
            raise InputError(system.name, "sensors", f"none of {drive!r}", "every drive measured")
        drives.append(channels.index(drive))
        # tau_i is measured before the gear.
        ratio = system.joints[i - 1].gear_ratio if drive.startswith("tau_") else 1.0
        torque[i - 1] = density[drives[-1]] * ratio**2
    for i, wrench in enumerate(wrench_channels(system), start=len(system.joints)):
        if wrench not in channels:
            raise InputError(system.name, "sensors", f"none of {wrench!r}", "every wrench measured")
        drives.append(channels.index(wrench))
        torque[i] = density[drives[-1]]
    others = [k for k in range(len(channels)) if k not in drives]
    return SensorSet(tuple(channels[k] for k in others), density[others], torque)


def session_sensors(sensing: Sensing, noise: SensorNoise) -> SensorSet:
    """The position sensors and torques that a session has used, with the noise that it has used of them."""
    channels = tuple(sensing.channels[column] for column in sensing.position_columns)
    return SensorSet(channels, noise.sensors, noise.torque)
