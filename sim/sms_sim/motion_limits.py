"""What a designed motion must stay within: limits that are stated, and the extremes of the described motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sms_online.errors import InputError
from sms_online.model.readings import Readings, readable_channels
from sms_online.stream import Array
from sms_sim.plant import Plant

Kind = Literal["angle", "rate", "torque", "base_rotation", "deflection"]


@dataclass(frozen=True)
class Limits:
    """Largest magnitudes that a motion may reach; None means those of the described motion.

    angle, rate: of each joint, rad and rad/s (m and m/s). torque: of each joint after its gear, N m (N). base_rotation:
    from its attitude at the start, rad. deflection: of each marker from where it is on the undeformed link, m.
    """

    angle: float | None = None
    rate: float | None = None
    torque: float | None = None
    base_rotation: float | None = None
    deflection: float | None = None

    def of(self, kind: Kind) -> float | None:
        """The limit of a kind."""
        value: float | None = getattr(self, kind)
        return value


@dataclass(frozen=True)
class Signal:
    """A number of a motion that is limited.

    stated: a stated limit of its kind is meant for it; others of the kind are then free.
    """

    name: str
    unit: str
    kind: Kind
    stated: bool


class Extremes:
    """Largest magnitudes of the signals of motions: every state, what limits can be stated for, and every torque."""

    def __init__(self, plant: Plant) -> None:
        self._plant, layout = plant, plant.model.layout
        self._linear = len(layout.base_linear)
        elastic = {k for q_f in layout.q_f for k in range(q_f.start, q_f.stop)}
        markers = [name for name in readable_channels(plant.model) if name.rpartition(".")[2].startswith("u_")]
        self._markers = Readings(plant.model, markers)
        signals = [Signal(name, "m", "base_rotation", False) for name in layout.position_names[: self._linear]]
        if layout.free:
            signals.append(Signal("rotation of the base", "rad", "base_rotation", True))
        for k, name in enumerate(layout.speed_names[layout.n_base_speeds :], start=layout.n_base_speeds):
            unit = _unit(name)
            signals.append(Signal(name, unit, "deflection" if k in elastic else "angle", k in layout.q))
        for k, name in enumerate(layout.speed_names):
            base, unit = k < layout.n_base_speeds, f"{_unit(name)}/s"
            kind: Kind = "base_rotation" if base else "deflection" if k in elastic else "rate"
            signals.append(Signal(name if base else f"rate of {name}", unit, kind, k in layout.q))
        signals += [Signal(f"{name}, magnitude", "m", "deflection", True) for name in markers]
        signals += [Signal(f"torque of joint {i}", "N m", "torque", True) for i in range(1, len(layout.q) + 1)]
        self.signals = tuple(signals)

    def __call__(self, x: Array, v: Array, torque: Array) -> Array:
        """Extremes (signals,) of a motion x (N, n_x), v (N, n_v), torque (N, joints or more)."""
        return np.asarray(self.magnitudes(x, v, torque).max(axis=0))

    def magnitudes(self, x: Array, v: Array, torque: Array) -> Array:
        """Magnitudes (N, signals) along a motion."""
        layout = self._plant.model.layout
        parts = [x[:, : self._linear]]
        if layout.free:
            _, T = layout.base_pose(x)
            cosine = 0.5 * (np.einsum("bij,ij->b", T, T[0]) - 1.0)
            turned = np.abs(x[:, 2] - x[0, 2]) if layout.planar else np.arccos(np.clip(cosine, -1.0, 1.0))
            parts.append(turned[:, None])
        parts += [layout.joint_positions(x), v, self._markers(x, v), torque[:, : len(layout.q)]]
        return np.abs(np.concatenate(parts, axis=1))

    def bounds(self, limits: Limits, described: Array | None) -> Array:
        """Largest magnitude allowed of each signal (signals,); inf where there is none.

        described: extremes of the described motion, where there is one. InputError where a stated limit has nothing to
        limit.
        """
        stated = {signal.kind for signal in self.signals if signal.stated}
        for kind, limit in vars(limits).items():
            if limit is not None and kind not in stated:
                found = f"nothing that a limit of the {kind.replace('_', ' ')} holds for"
                raise InputError(self._plant.system.name, "limits", found, "a limit of what this arm has")
        out = np.full(len(self.signals), np.inf) if described is None else described.copy()
        for k, signal in enumerate(self.signals):
            limit = limits.of(signal.kind)
            if limit is not None:
                out[k] = limit if signal.stated else np.inf
        return out


def _unit(name: str) -> str:
    """Unit of a coordinate or of what a speed is the rate of; joints count as revolute."""
    last = name.rpartition(".")[2]
    return "m" if last.startswith(("u_", "v_", "r_")) else "rad"
