"""What a testbed's sensors read of its motion, and how its displacements and speeds change that."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.description.channels import AXES, channels, strain_channel
from sms_online.errors import InputError
from sms_online.model import so3
from sms_online.model.model import Model
from sms_online.model.points import Points
from sms_online.stream import Array


class Readings:
    """Exact readings of channels along a motion.

    Known are the poses, markers and strains of `Sensing`, rates of the base, a gyro on it, and markers as cameras see
    them. Raises InputError, naming the system, where a channel is not one of them.
    """

    def __init__(self, model: Model, channels: Sequence[str]) -> None:
        self._model = model
        points = Points(model.system, model.chain)
        known = (*_joint_channels(model), *points.names)
        for name in channels:
            if name not in known:
                place = f"channel {name!r}"
                raise InputError(model.system.name, place, "no model of this reading", f"one of {', '.join(known)}")
        self._columns = [known.index(name) for name in channels]
        # Points take a configuration of the whole chain.
        self._points = points if any(name in points.names for name in channels) else None
        layout = model.layout
        self._rigid = layout.n_x - sum(q_f.stop - q_f.start for q_f in layout.q_f)
        self._strips = _strips(model)

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
            parts.append((self._omega(v)[:, None] @ T_0)[:, 0, list(layout.base_angular)])
        offset = layout.offset
        parts += [x[:, [layout.q[i] + offset]] - x[:, [layout.theta_m[i] + offset]] for i in self._strips]
        if self._points is not None:
            parts.append(self._points(x))
        return np.concatenate(parts, axis=1)[:, self._columns]

    def derivatives(self, x: Array, v: Array) -> tuple[Array, Array]:
        """Derivatives (B, channels, n_v) by displacements in the order of the speeds, and by speeds."""
        layout, chain = self._model.layout, self._model.chain
        B, n_v = v.shape
        unit = np.broadcast_to(np.eye(n_v), (B, n_v, n_v))
        moved = layout.position_rate(np.repeat(x, n_v, axis=0), unit.reshape(-1, n_v))
        by_x = [moved.reshape(B, n_v, -1).swapaxes(1, 2)[:, : self._rigid]]
        for i, kinematics in enumerate(chain.flexible):
            if kinematics is not None:
                by_x.append(kinematics.marker_jacobian(chain.elastic(x, i)) @ unit[:, layout.q_f[i]])
        before = sum(part.shape[1] for part in by_x)
        rates = unit[:, : layout.n_base_speeds]
        by_x.append(np.zeros_like(rates))
        by_v = [rates]
        if layout.free:
            _, T_0 = layout.base_pose(x)
            back = T_0.swapaxes(1, 2)[:, list(layout.base_angular)]
            angular = unit[:, len(layout.base_linear) : layout.n_base_speeds]
            # A small inertial rotation φ of the attitude changes T_0ᵀ ω by T_0ᵀ (ω × φ).
            turned = (back @ so3.skew(self._omega(v)))[:, :, list(layout.base_angular)]
            by_x.append(turned @ angular)
            by_v.append(back[:, :, list(layout.base_angular)] @ angular)
        by_x += [unit[:, [layout.q[i]]] - unit[:, [layout.theta_m[i]]] for i in self._strips]
        if self._points is not None:
            by_x.append(self._points.by_displacement(x))
        displaced = np.concatenate(by_x, axis=1)
        sped = np.zeros_like(displaced)
        both = np.concatenate(by_v, axis=1)
        sped[:, before : before + both.shape[1]] = both
        return displaced[:, self._columns], sped[:, self._columns]

    def _omega(self, v: Array) -> Array:
        """Inertial ω_0 (B, 3)."""
        layout = self._model.layout
        omega = np.zeros((len(v), 3))
        omega[:, list(layout.base_angular)] = v[:, len(layout.base_linear) : layout.n_base_speeds]
        return omega


def readable_channels(model: Model) -> tuple[str, ...]:
    """Channels that `Readings` knows: poses of base and joints, markers in link frames, rates, gyro, strain, points."""
    offered = channels(model.system)
    known = (*_joint_channels(model), *Points(model.system, model.chain).names)
    return tuple(name for name in known if name in offered)


def position_channels(model: Model) -> tuple[str, ...]:
    """Channels of poses and markers: those in link frames, or in the laboratory's axes where places are stated."""
    pointed = tuple(f"link_{i}." for i, link in enumerate(model.system.links, start=1) if link.markers)
    own = (name for name in _joint_channels(model)[: model.layout.n_x] if not name.startswith(pointed))
    points = (name for name in Points(model.system, model.chain).names if name.startswith(pointed))
    return (*own, *points)


def _joint_channels(model: Model) -> tuple[str, ...]:
    """Channels that need no configuration of the chain."""
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
