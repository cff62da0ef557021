"""Nuisances of geometry, and the systems that they make of a described one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from sms_online.calibration.nuisance import Nuisance
from sms_online.description.bodies import FlexibleLink, Joint, Mount
from sms_online.description.channels import AXES
from sms_online.description.schema import System
from sms_online.description.tree import BASE, mounts, tree_of
from sms_online.model.beam import LinearLink
from sms_online.model.model import Model
from sms_online.model.so3 import skew
from sms_online.stream import Array

# Step of the differences that give derivatives, m or rad: 1e-6 of them is lost to curvature, less to rounding.
STEP = 1e-6
# Gravity, m/s², less than anywhere on the ground: what a plane does not hold of it lies across the plane.
LEAST_GRAVITY = 9.76


def same_readings(described: Model, moved: Model, x: Array, v: Array) -> tuple[Array, Array]:
    """States of the moved geometry that its sensors read the same in: strains of exact links follow from markers.

    x (K, n_x), v (K, n_v): of the described one.
    """
    x, v = x.copy(), v.copy()
    offset = described.layout.n_base_positions - described.layout.n_base_speeds
    pairs = zip(described.chain.flexible, moved.chain.flexible, described.layout.q_f, strict=True)
    for link, other, q_f in pairs:
        if link is None or other is None or link is other or isinstance(link, LinearLink):
            continue
        own = slice(q_f.start + offset, q_f.stop + offset)
        rates = link.marker_jacobian(x[:, own]) @ v[:, q_f, None]
        x[:, own] = other.coordinates(link.markers(x[:, own]))
        v[:, q_f] = np.linalg.solve(other.marker_jacobian(x[:, own]), rates)[..., 0]
    return x, v


def on_base(system: System, place: tuple[float, float, float], tolerance: float) -> Array:
    """Tolerance (3,) of a place on a free base, m, along its axes.

    No sample distinguishes another zero of the measured attitude from places, axes and masses of the base that are all
    turned. So its frame is the one that is measured, in which less is known of what is on it.
    """
    about = [2] if system.motion == "planar" else [0, 1, 2]
    return np.asarray(
        np.hypot(tolerance, _base_angle(system) * np.linalg.norm(skew(np.array(place))[:, about], axis=1))
    )


def axis_tolerance(system: System, i: int) -> float:
    """Tolerance of where joint i (from 0) is mounted turned to, rad; see `on_base`."""
    turned = _base_angle(system) if tree_of(system).parents[i] == BASE else 0.0
    return float(np.hypot(system.tolerances.axis, turned))


def _base_angle(system: System) -> float:
    return 0.0 if system.spacecraft is None else system.tolerances.base_angle


@dataclass(frozen=True)
class Geometry:
    """A nuisance of geometry; moved: the system with so much of it."""

    nuisance: Nuisance
    moved: Callable[[System, float], System]


def own_axis(joint: Mount) -> int | None:
    """Axis of the mount that a joint turns about, which its encoders measure fully; None where there is none."""
    if not isinstance(joint, Joint) or joint.kind != "revolute":
        return None
    turning = np.flatnonzero(np.abs(joint.axis) == 1.0)
    return int(turning[0]) if turning.size else None


def geometries(system: System) -> Iterator[Geometry]:
    """A system's nuisances of geometry that have a tolerance; of a planar one only what keeps it planar.

    Not those that other readings replace: see `channels`.
    """
    planar, tolerances, tree = system.motion == "planar", system.tolerances, tree_of(system)
    for i, link in enumerate(system.links):
        if tolerances.length == 0.0:
            break
        if isinstance(link, FlexibleLink):
            yield Geometry(Nuisance("length", f"link_{i + 1}", "m", tolerances.length), partial(_longer, i))
        elif i in tree.parents or (i == tree.last and system.payload is not None):
            for axis in range(2 if planar else 3):
                nuisance = Nuisance("length", f"link_{i + 1}", "m", tolerances.length, AXES[axis])
                yield Geometry(nuisance, partial(_displaced, "links", i, "tip", axis))
    for i, mount in enumerate(mounts(system)):
        where = ("joints", i) if i < len(system.joints) else ("fixed_joints", i - len(system.joints))
        lengths = np.full(3, tolerances.length)
        if tree.parents[i] == BASE:
            lengths = on_base(system, mount.mount_position, tolerances.length)
        for axis in range(2 if planar else 3):
            if any(mount.mount_position) and lengths[axis] > 0.0:
                nuisance = Nuisance("length", f"joint_{i + 1}", "m", float(lengths[axis]), AXES[axis])
                yield Geometry(nuisance, partial(_displaced, *where, "mount_position", axis))
        for axis in (2,) if planar else (0, 1, 2):
            if axis_tolerance(system, i) > 0.0 and axis != own_axis(mount):
                nuisance = Nuisance("axis", f"joint_{i + 1}", "rad", axis_tolerance(system, i), AXES[axis])
                yield Geometry(nuisance, partial(_mount_turned, *where, axis))
    gravity = np.array(system.gravity)
    if gravity.any() and tolerances.gravity > 0.0:
        for part, about in _tilts(gravity, planar):
            yield Geometry(
                Nuisance("gravity", "base", "rad", tolerances.gravity, part), partial(_tilted, about, planar)
            )


def _with(records: tuple[object, ...], i: int, **changed: object) -> tuple[object, ...]:
    record = records[i].model_copy(update=changed)  # type: ignore[attr-defined]
    return (*records[:i], record, *records[i + 1 :])


def _longer(i: int, system: System, by: float) -> System:
    link = system.links[i]
    assert isinstance(link, FlexibleLink)
    return system.model_copy(update={"links": _with(system.links, i, length=link.length + by)})


def _displaced(records: str, i: int, point: str, axis: int, system: System, by: float) -> System:
    """A point of the i-th (from 0) of some records of a system, along an axis."""
    every = getattr(system, records)
    moved = np.array(getattr(every[i], point)) + by * np.eye(3)[axis]
    return system.model_copy(update={records: _with(every, i, **{point: tuple(moved.tolist())})})


def _mount_turned(records: str, i: int, axis: int, system: System, by: float) -> System:
    every = getattr(system, records)
    mount = Rotation.from_rotvec(every[i].mount_rotation) * Rotation.from_rotvec(by * np.eye(3)[axis])
    return system.model_copy(update={records: _with(every, i, mount_rotation=tuple(mount.as_rotvec().tolist()))})


def _tilts(gravity: Array, planar: bool) -> Iterator[tuple[str, Array]]:
    """Names and axes of rotations that gravity may be off by; of a plane that is not upright its slope too."""
    if not planar:
        for k, vector in enumerate(np.linalg.svd(gravity[None])[2][1:], start=1):
            yield f"direction {k}", np.asarray(vector)
        return
    yield "z", np.array([0.0, 0.0, 1.0])
    if _across(gravity) > 0.0:
        yield "x", np.array([1.0, 0.0, 0.0])
        yield "y", np.array([0.0, 1.0, 0.0])


def _across(gravity: Array) -> float:
    """Gravity across the plane, m/s², of which a planar system states what lies in it."""
    return float(np.sqrt(max(LEAST_GRAVITY**2 - float(gravity @ gravity), 0.0)))


def _tilted(about: Array, planar: bool, system: System, by: float) -> System:
    gravity = np.array(system.gravity)
    if planar:
        gravity[2] = -_across(gravity)
    turned = Rotation.from_rotvec(by * about).apply(gravity)
    if planar:
        turned[2] = 0.0
    return system.model_copy(update={"gravity": tuple(turned.tolist())})
