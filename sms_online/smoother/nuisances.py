"""What readings of a smoother may be off by: clocks, zeros of encoders and markers, places of markers, scale."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.calibration.geometry import on_base
from sms_online.calibration.nuisance import Nuisance
from sms_online.description.channels import AXES
from sms_online.description.sources import source_channels
from sms_online.grouping import grouped
from sms_online.model.model import Model
from sms_online.model.points import Points
from sms_online.pipeline.clocks import clock_of
from sms_online.stream import Array

MARKER = re.compile(r"link_\d+\.marker_\d+\.(?P<kind>u_|theta_)?[xyz]")
ENCODER = re.compile(r"(q|theta_m)_(?P<joint>\d+)")


@dataclass(frozen=True)
class _Motion:
    """Positions x (B, n_x), readings and their rates (B, C) along a motion."""

    x: Array
    readings: Array
    rates: Array


@dataclass(frozen=True)
class _Family:
    """Nuisances of one kind, and what one unit of each adds to the readings, (B, C, c)."""

    nuisances: tuple[Nuisance, ...]
    adds: Callable[[_Motion], Array]


class ReadingNuisances:
    """Nuisances of a session's readings. all (m,): each with a tolerance."""

    def __init__(self, model: Model, channels: Sequence[str]) -> None:
        self._model, self._channels = model, list(channels)
        families = [family for family in self._families() if family.nuisances]
        self._kept = [family for family in families if all(each.tolerance > 0.0 for each in family.nuisances)]
        self.all = tuple(each for family in self._kept for each in family.nuisances)

    def columns(self, x: Array, v: Array, by_position: Array, readings: Array, sensed: Sequence[int]) -> Array:
        """What one unit of each adds to the readings of the channels sensed, (B, sensed, m).

        by_position (B, sensed, n_v): derivatives of these readings (B, sensed) by displacements, at x (B, n_x) and
        speeds v (B, n_v).
        """
        every = np.zeros((2, len(x), len(self._channels)))
        every[0][:, sensed] = readings
        every[1][:, sensed] = (by_position @ v[..., None])[..., 0]
        motion = _Motion(x, every[0], every[1])
        parts = [np.empty((len(x), len(self._channels), 0)), *(family.adds(motion) for family in self._kept)]
        return np.concatenate(parts, axis=2)[:, sensed]

    def _families(self) -> Iterator[_Family]:
        names, tolerances = self._channels, self._model.system.tolerances
        groups = self._clocks()
        late = np.zeros((len(names), len(groups)))
        for column, own in zip(late.T, groups.values(), strict=True):
            column[own] = -1.0
        clocks = tuple(Nuisance("clock", name, "s", tolerances.clock) for name in groups)
        yield _Family(clocks, lambda motion: motion.rates[:, :, None] * late)
        yield from self._zeros()
        yield from self._encoders()
        yield from self._cameras()

    def _clocks(self) -> dict[str, list[int]]:
        """Numbers of the position channels that share a clock, those aside which come with the torques."""
        names, system, base = self._channels, self._model.system, self._model.layout.position_names
        base = base[: self._model.layout.n_base_positions]
        devices = {source.name: set(source_channels(source)) for source in system.sources}
        if len(devices) > 1:
            apart = {
                name: [k for k, channel in enumerate(names) if channel in own]
                for name, own in devices.items()
                if not any(channel.startswith(("tau_", "force_")) for channel in own)
            }
            return {name: own for name, own in apart.items() if own}
        timed = (k for k, name in enumerate(names) if name in base or MARKER.fullmatch(name) or ENCODER.fullmatch(name))
        return grouped((clock_of(names[k], names, base), k) for k in timed)

    def _zeros(self) -> Iterator[_Family]:
        tolerances = self._model.system.tolerances
        units = {"encoder_zero": "", "marker_zero": "m", "marker_zero_angle": "rad"}
        chosen: dict[str, list[int]] = {name: [] for name in units}
        for k, name in enumerate(self._channels):
            marker = MARKER.fullmatch(name)
            if ENCODER.fullmatch(name):
                chosen["encoder_zero"].append(k)
            elif marker and marker["kind"]:
                chosen["marker_zero" if marker["kind"] == "u_" else "marker_zero_angle"].append(k)
        for tolerance, own in chosen.items():
            size = getattr(tolerances, tolerance)
            nuisances = tuple(
                Nuisance(tolerance, self._channels[k], units[tolerance] or self._unit(k), size) for k in own
            )
            yield _Family(nuisances, self._constant(own))

    def _encoders(self) -> Iterator[_Family]:
        turning = [k for k, name in enumerate(self._channels) if ENCODER.fullmatch(name) and self._unit(k) == "rad"]
        size, select = self._model.system.tolerances.once_per_turn, np.eye(len(self._channels))[:, turning]
        for part, wave in (("sine", np.sin), ("cosine", np.cos)):
            nuisances = tuple(Nuisance("once_per_turn", self._channels[k], "rad", size, part) for k in turning)
            yield _Family(nuisances, lambda motion, wave=wave: wave(motion.readings)[:, :, None] * select)  # type: ignore[misc]

    def _cameras(self) -> Iterator[_Family]:
        """Places of markers that are seen as points, the tracked point, and the scale of all that is seen."""
        model, names, tolerances = self._model, self._channels, self._model.system.tolerances
        layout = model.layout
        points, axes = Points(model.system, model.chain), AXES[:2] if layout.planar else AXES
        seen = [name for name in points.names if name in names]
        places = tuple(
            Nuisance("marker_station", name.rpartition(".")[0], "m", tolerances.marker_station, name[-1])
            for name in seen
        )
        rows, own = [names.index(name) for name in seen], [points.names.index(name) for name in seen]

        def placed(motion: _Motion) -> Array:
            out = np.zeros((len(motion.x), len(names), len(seen)))
            out[:, rows] = points.by_place(motion.x)[:, own][:, :, own]
            return out

        yield _Family(places, placed)
        base = [f"r_S_{axis}" for axis in axes]
        if model.system.spacecraft is not None and set(base) <= set(names):
            at = [names.index(name) for name in base]
            size = on_base(model.system, model.system.spacecraft.tracked_point, tolerances.tracked_point)

            def tracked(motion: _Motion) -> Array:
                out = np.zeros((len(motion.x), len(names), len(axes)))
                out[:, at] = layout.base_pose(motion.x)[1][:, : len(axes), : len(axes)]
                return out

            known = tuple(Nuisance("tracked_point", "base", "m", float(size[k]), axis) for k, axis in enumerate(axes))
            yield _Family(known, tracked)
        metres = [k for k, name in enumerate(names) if name in base or (MARKER.fullmatch(name) and "theta" not in name)]
        select = np.isin(np.arange(len(names)), metres)
        scale = (Nuisance("camera_scale", "base and markers", "", tolerances.camera_scale),) if metres else ()
        yield _Family(scale, lambda motion: (motion.readings * select)[:, :, None])

    def _unit(self, k: int) -> str:
        found = ENCODER.fullmatch(self._channels[k])
        assert found is not None
        return "m" if self._model.system.joints[int(found["joint"]) - 1].kind == "prismatic" else "rad"

    def _constant(self, own: Sequence[int]) -> Callable[[_Motion], Array]:
        select = np.eye(len(self._channels))[:, list(own)]
        return lambda motion: np.broadcast_to(select, (len(motion.x), *select.shape))
