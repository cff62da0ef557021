"""What a testbed's sensors read of its motion, and with how much noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.description.channels import AXES, drive_channels, strain_channel
from sms_online.errors import InputError
from sms_online.model.model import Model
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.stream import Array


class Readings:
    """Exact readings of channels along a motion.

    Known are the poses, markers and strains of `Sensing`, rates of the base, and a gyro on it. Raises InputError,
    naming the system, where a channel is not one of them.
    """

    def __init__(self, model: Model, channels: Sequence[str]) -> None:
        self._model = model
        names = readable_channels(model)
        for name in channels:
            if name not in names:
                place = f"channel {name!r}"
                raise InputError(model.system.name, place, "no model of this reading", f"one of {', '.join(names)}")
        self._columns = [names.index(name) for name in channels]
        layout = model.layout
        self._rigid = layout.n_x - sum(q_f.stop - q_f.start for q_f in layout.q_f)
        self._strips = _strips(model)
        # After the positions come rates, those of the base and then the gyro's.
        rates = range(layout.n_x, layout.n_x + layout.n_base_speeds + len(layout.base_angular))
        self.reads_rates = any(column in rates for column in self._columns)

    def __call__(self, x: Array, v: Array) -> Array:
        """Readings (B, channels) at x (B, n_x), v (B, n_v)."""
        layout, chain = self._model.layout, self._model.chain
        parts = [x[:, : self._rigid]]
        for i, kinematics in enumerate(chain.flexible):
            if kinematics is not None:
                parts.append(kinematics.markers(chain.elastic(x, i)))
        parts.append(v[:, : layout.n_base_speeds])
        if layout.free:
            _, T_0 = layout.base_pose(x)
            omega = np.zeros((x.shape[0], 3))
            linear = len(layout.base_linear)
            omega[:, list(layout.base_angular)] = v[:, linear : layout.n_base_speeds]
            parts.append((omega[:, None] @ T_0)[:, 0, list(layout.base_angular)])
        offset = layout.n_base_positions - layout.n_base_speeds
        parts += [x[:, [layout.q[i] + offset]] - x[:, [layout.theta_m[i] + offset]] for i in self._strips]
        return np.concatenate(parts, axis=1)[:, self._columns]


def readable_channels(model: Model) -> tuple[str, ...]:
    """Channels that `Readings` knows: poses of base and joints, markers in link frames, rates, the gyro, strain."""
    layout = model.layout
    rigid = layout.n_x - sum(q_f.stop - q_f.start for q_f in layout.q_f)
    markers = [
        f"link_{i}.{name}"
        for i, kinematics in enumerate(model.chain.flexible, start=1)
        if kinematics is not None
        for name in kinematics.marker_names
    ]
    gyro = [f"gyro_0_{AXES[axis]}" for axis in layout.base_angular]
    strain = [f"link_{i + 1}.strain_angle" for i in _strips(model)]
    return (*layout.position_names[:rigid], *markers, *layout.speed_names[: layout.n_base_speeds], *gyro, *strain)


def _strips(model: Model) -> list[int]:
    """Links, from 0, whose strain is the deflection of their joint."""
    return [i for i in range(len(model.system.joints)) if strain_channel(model.system, i + 1) is not None]


@dataclass(frozen=True)
class SensorSet:
    """Sensors with white noise.

    channels: what is read, see `Readings`. density (channels,): σ² T_s of each, its unit squared times s. torque
    (joints,): the same of n τ, (N m)² s ((N)² s).
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
    torque = np.zeros(len(system.joints))
    drives = []
    for drive, i in drive_channels(system).items():
        if drive not in channels:
            raise InputError(system.name, "sensors", f"none of {drive!r}", "every drive measured")
        drives.append(channels.index(drive))
        # tau_i is measured before the gear.
        ratio = system.joints[i - 1].gear_ratio if drive.startswith("tau_") else 1.0
        torque[i - 1] = density[drives[-1]] * ratio**2
    others = [k for k in range(len(channels)) if k not in drives]
    return SensorSet(tuple(channels[k] for k in others), density[others], torque)


def session_sensors(sensing: Sensing, noise: SensorNoise) -> SensorSet:
    """The position sensors and torques that a session has used, with the noise that it has used of them."""
    channels = tuple(sensing.channels[column] for column in sensing.position_columns)
    return SensorSet(channels, noise.sensors, noise.torque)
