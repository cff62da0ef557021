"""Nuisances of channels: what a reading differs by from the true one, for one unit of each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sms_online.calibration.geometry import axis_tolerance, on_base, own_axis
from sms_online.calibration.multiplied_noise import Multiplied
from sms_online.calibration.nuisance import Nuisance
from sms_online.description.channels import AXES
from sms_online.description.schema import Tolerances
from sms_online.effects.catalogue import ENTRIES
from sms_online.pipeline.clocks import GAUGES, MARKER, other_clocks
from sms_online.pipeline.sensing import Sensing
from sms_online.stream import Array

# Along the link a displacement changes by this rotation, with this sign.
SLOPES = {"y": ("z", 1.0), "z": ("y", -1.0)}


@dataclass(frozen=True)
class Motion:
    """Readings (K, sensors) of the position sensors at K instants, with their rates, and the torques n τ (K, joints).

    base_rotation (K, 3, 3): T_0.
    """

    readings: Array
    rates: Array
    torque: Array
    base_rotation: Array


@dataclass(frozen=True)
class Family:
    """Nuisances of one kind: of position sensors, whose readings are (K, sensors), or of torques n τ, (K, joints).

    adds: motion to what one unit of each adds to these, (K, ·, c). multiplies: what each adds a multiple of its own
    readings to, none by default.
    """

    nuisances: tuple[Nuisance, ...]
    adds: Callable[[Motion], Array]
    multiplies: tuple[Multiplied, ...] = ()

    @property
    def tolerated(self) -> bool:
        """Whether it has nuisances, which may differ from zero."""
        return bool(self.nuisances) and all(each.tolerance > 0.0 for each in self.nuisances)


@dataclass(frozen=True)
class Families:
    """Nuisances of a session's channels, in this order. positions: of the position sensors. torques: of the torques.

    low_passes: those whose rate is what one unit of each adds to the position sensors' readings.
    """

    positions: tuple[Family, ...]
    low_passes: tuple[Family, ...]
    torques: tuple[Family, ...]

    @classmethod
    def of(cls, sensing: Sensing) -> Families:
        """Those that have a tolerance."""
        tolerances = sensing.model.system.tolerances
        names = [sensing.channels[column] for column in sensing.position_columns]
        positions = (
            *_clocks(sensing, names, tolerances.clock),
            *_encoders(sensing, names, tolerances),
            *_markers(names, tolerances),
            *_camera(sensing, names, tolerances),
        )
        every = (positions, _low_passes(names, tolerances), _torques(sensing, tolerances))
        return cls(*(tuple(family for family in families if family.tolerated) for families in every))

    @property
    def nuisances(self) -> tuple[Nuisance, ...]:
        """Of all."""
        return nuisances_of((*self.positions, *self.low_passes, *self.torques))

    @property
    def multiplied(self) -> tuple[Multiplied, ...]:
        """What nuisances multiply, by their number."""
        out, first = [], 0
        for family in (*self.positions, *self.low_passes, *self.torques):
            out += [replace(each, column=first + k) for k, each in enumerate(family.multiplies)]
            first += len(family.nuisances)
        return tuple(out)


def multiplying(sensing: Sensing) -> tuple[int, ...]:
    """Numbers of the nuisances that multiply noise."""
    return tuple(each.column for each in Families.of(sensing).multiplied if each.column is not None)


def nuisances_of(families: Iterable[Family]) -> tuple[Nuisance, ...]:
    """Nuisances of some families, in their order."""
    return tuple(each for family in families for each in family.nuisances)


def added(families: Iterable[Family], motion: Motion, width: int) -> Array:
    """What one unit of each nuisance adds to so many readings or torques, (K, width, ·)."""
    none = np.empty((len(motion.readings), width, 0))
    return np.concatenate((none, *(family.adds(motion) for family in families)), axis=2)


def _low_passes(names: Sequence[str], tolerances: Tolerances) -> list[Family]:
    """A low-pass of second order reads y of x = y + c ẏ + ÿ / ω²: beside the clock, which is late by c, it has ω."""
    gauges = [k for k, name in enumerate(names) if name.endswith("strain_angle")]
    if not gauges or not tolerances.gauge_low_pass:
        return []
    read = np.isin(np.arange(len(names)), gauges)
    low_pass = Nuisance("gauge_low_pass", GAUGES, "s²", tolerances.gauge_low_pass)
    return [Family((low_pass,), lambda motion: -(motion.rates * read)[:, :, None])]


def _torques(sensing: Sensing, tolerances: Tolerances) -> list[Family]:
    """Not what the system file declares as effects."""
    effects = sensing.model.system.effects
    declared = {(name, e.where) for e in effects for name in ENTRIES[e.name].traits.calibrates}
    joints = [i for i, joint in enumerate(sensing.model.system.joints) if not joint.passive]
    units = ["N" if joint.kind == "prismatic" else "N m" for joint in sensing.model.system.joints]
    offset = np.inf if tolerances.drive_offset is None else tolerances.drive_offset
    # Unless a parameter is known, a gain that is common to all torques is that of all parameters.
    first = 1 if sensing.model.system.scale_tolerance is not None else 0
    part = "against joint_1" if first else ""
    gained = [i for i in joints if i >= first and ("drive_gain", f"joint_{i + 1}") not in declared]
    shifted = [i for i in joints if ("drive_offset", f"joint_{i + 1}") not in declared]
    return [
        Family(
            tuple(Nuisance("drive_gain", f"joint_{i + 1}", "", tolerances.drive_gain, part) for i in gained),
            partial(_of_torque, np.positive, gained),
            tuple(Multiplied(None, joints=(i,)) for i in gained),
        ),
        Family(
            tuple(Nuisance("drive_offset", f"joint_{i + 1}", units[i], offset) for i in shifted),
            partial(_of_torque, np.ones_like, shifted),
        ),
    ]


def _clocks(sensing: Sensing, names: Sequence[str], tolerance: float) -> Iterator[Family]:
    """Later than the torques, by device."""
    chosen = other_clocks(sensing)
    select = np.zeros((len(names), len(chosen)))
    for column, sensors in zip(select.T, chosen.values(), strict=True):
        column[sensors] = -1.0
    nuisances = tuple(Nuisance("clock", name, "s", tolerance, part) for name, part in chosen)
    yield Family(nuisances, lambda motion: motion.rates[:, :, None] * select)


def _encoders(sensing: Sensing, names: Sequence[str], tolerances: Tolerances) -> Iterator[Family]:
    system = sensing.model.system
    joints = system.joints
    encoders = [k for k, name in enumerate(names) if name.startswith(("q_", "theta_m_"))]
    turning = [k for k in encoders if joints[int(names[k].rsplit("_", 1)[1]) - 1].kind == "revolute"]
    one, turn = _selection(names, encoders), _selection(names, turning)
    units = ["rad" if k in turning else "m" for k in encoders]
    zeros = [
        Nuisance("encoder_zero", names[k], unit, tolerances.encoder_zero)
        for k, unit in zip(encoders, units, strict=True)
    ]
    yield Family(tuple(zeros), partial(_constant, one))
    # A joint that is mounted turned about its own axis reads as if it stood elsewhere.
    own_axes = {i: axis for i, joint in enumerate(joints) if (axis := own_axis(joint)) is not None}
    mounted = {i: axis for i, axis in own_axes.items() if axis_tolerance(system, i) > 0.0}
    turned = np.zeros((len(names), len(mounted)))
    for column, (i, axis) in zip(turned.T, mounted.items(), strict=True):
        own = [k for k in encoders if int(names[k].rsplit("_", 1)[1]) == i + 1]
        column[own] = -np.sign(joints[i].axis[axis])
    mounts = [
        Nuisance("axis", f"joint_{i + 1}", "rad", axis_tolerance(system, i), AXES[axis]) for i, axis in mounted.items()
    ]
    yield Family(tuple(mounts), partial(_constant, turned))
    for part, wave in (("sine", np.sin), ("cosine", np.cos)):
        waves = [Nuisance("once_per_turn", names[k], "rad", tolerances.once_per_turn, part) for k in turning]
        yield Family(tuple(waves), partial(_times, wave, turn))


def _markers(names: Sequence[str], tolerances: Tolerances) -> Iterator[Family]:
    found = {k: match for k, name in enumerate(names) if (match := MARKER.fullmatch(name))}
    for kind, tolerance, unit in (("u", "marker_zero", "m"), ("theta", "marker_zero_angle", "rad")):
        own = [k for k, match in found.items() if match["kind"] == kind]
        nuisances = tuple(Nuisance(tolerance, names[k], unit, getattr(tolerances, tolerance)) for k in own)
        yield Family(nuisances, partial(_constant, _selection(names, own)))
    # A marker further along its link reads the displacement there.
    markers = list(dict.fromkeys(match["marker"] for match in found.values()))
    steps = np.zeros((len(names), len(names), len(markers)))  # reading, rotation that it changes by, marker
    for k, match in found.items():
        if match["kind"] == "u" and match["axis"] in SLOPES:
            axis, sign = SLOPES[match["axis"]]
            rotation = f"{match['marker']}.theta_{axis}"
            if rotation in names:
                steps[k, names.index(rotation), markers.index(match["marker"])] = sign
    nuisances = tuple(Nuisance("marker_station", marker, "m", tolerances.marker_station) for marker in markers)
    yield Family(nuisances, lambda motion: np.einsum("ks,rsm->krm", motion.readings, steps))


def _camera(sensing: Sensing, names: Sequence[str], tolerances: Tolerances) -> Iterator[Family]:
    layout = sensing.model.layout
    metres = [k for k, name in enumerate(names) if (match := MARKER.fullmatch(name)) and match["kind"] == "u"]
    if layout.free:
        metres += range(len(layout.base_linear))
    if metres:
        scale = (
            Nuisance("camera_scale", "base and markers" if layout.free else "markers", "", tolerances.camera_scale),
        )
        seen = np.isin(np.arange(len(names)), metres)
        yield Family(scale, lambda motion: (motion.readings * seen)[:, :, None], (Multiplied(None, tuple(metres)),))
    spacecraft = sensing.model.system.spacecraft
    if spacecraft is None:
        return
    linear = list(layout.base_linear)
    known = on_base(sensing.model.system, spacecraft.tracked_point, tolerances.tracked_point)
    axes = [axis for axis in linear if known[axis] > 0.0]
    points = tuple(Nuisance("tracked_point", "base", "m", float(known[axis]), AXES[axis]) for axis in axes)
    yield Family(points, partial(_tracked_point, linear, axes))


def _tracked_point(linear: Sequence[int], axes: Sequence[int], motion: Motion) -> Array:
    """The tracked point is further along some axes of the base, and its measured position with it."""
    out = np.zeros((*motion.readings.shape, len(axes)))
    out[:, : len(linear)] = motion.base_rotation[:, linear][:, :, axes]
    return out


def _selection(names: Sequence[str], chosen: Sequence[int]) -> Array:
    return np.eye(len(names))[:, list(chosen)]


def _times(function: Callable[[Array], Array], selection: Array, motion: Motion) -> Array:
    """A function of each reading, of some sensors alone."""
    return np.asarray(function(motion.readings)[:, :, None] * selection)


def _of_torque(function: Callable[[Array], Array], joints: Sequence[int], motion: Motion) -> Array:
    """A function of each torque, of some joints alone."""
    return function(motion.torque)[:, :, None] * np.eye(motion.torque.shape[1])[:, list(joints)]


def _constant(selection: Array, motion: Motion) -> Array:
    return np.broadcast_to(selection, (len(motion.readings), *selection.shape))
