"""How well the geometry of a description is known, and systems drawn within that."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sms_online.description.bodies import FlexibleLink, RigidLink
from sms_online.description.schema import System, Tolerances
from sms_online.stream import Array


def geometry_tolerances(system: System) -> Tolerances:
    """Tolerances of a system; where it calls its geometry exact, what a careful assembly and a calliper give.

    A description has so many digits, and no combination of parameters follows from the last of them.
    """
    stated, usual = system.tolerances, Tolerances()
    names = ("axis", "length", "tracked_point", "gravity")
    return usual.model_copy(update={name: getattr(stated, name) or getattr(usual, name) for name in names})


def perturbed(system: System, rng: np.random.Generator) -> System:
    """A system whose geometry differs from the described one by a draw from its tolerances.

    Of a planar system only what keeps it planar moves. Sizes and directions are drawn independently, from `rng`.
    """
    inside = np.array([1.0, 1.0, 0.0]) if system.motion == "planar" else np.ones(3)
    tolerances = geometry_tolerances(system)
    about = np.array([0.0, 0.0, 1.0]) if system.motion == "planar" else np.ones(3)

    def moved(point: tuple[float, float, float], tolerance: float) -> tuple[float, ...]:
        return _vector(np.array(point) + tolerance * inside * rng.standard_normal(3))

    def turned(rotation: tuple[float, float, float]) -> tuple[float, ...]:
        draw = Rotation.from_rotvec(tolerances.axis * about * rng.standard_normal(3))
        return _vector((Rotation.from_rotvec(rotation) * draw).as_rotvec())

    def mounted(mount: Any) -> Any:
        update = {"mount_rotation": turned(mount.mount_rotation)}
        if any(mount.mount_position):
            update["mount_position"] = moved(mount.mount_position, tolerances.length)
        return mount.model_copy(update=update)

    def resized(link: RigidLink | FlexibleLink) -> RigidLink | FlexibleLink:
        if isinstance(link, RigidLink):
            return link.model_copy(update={"tip": moved(link.tip, tolerances.length)})
        update: dict[str, Any] = {"length": link.length + tolerances.length * rng.standard_normal()}
        if any(link.root_position):
            update["root_position"] = moved(link.root_position, tolerances.length)
        if any(link.root_rotation):
            update["root_rotation"] = turned(link.root_rotation)
        return link.model_copy(update=update)

    update: dict[str, Any] = {
        "joints": tuple(mounted(joint) for joint in system.joints),
        "fixed_joints": tuple(mounted(joint) for joint in system.fixed_joints),
        "links": tuple(resized(link) for link in system.links),
        "gravity": moved(system.gravity, tolerances.gravity * float(np.linalg.norm(system.gravity))),
    }
    if system.spacecraft is not None:
        point = moved(system.spacecraft.tracked_point, tolerances.tracked_point)
        update["spacecraft"] = system.spacecraft.model_copy(update={"tracked_point": point})
    return system.model_copy(update=update)


def _vector(values: Array) -> tuple[float, ...]:
    return tuple(values.tolist())
