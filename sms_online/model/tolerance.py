"""How well the geometry of a description is known, and systems drawn within that."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sms_online.description.schema import FlexibleLink, Joint, RigidLink, System
from sms_online.stream import Array

# 1σ of a direction of a joint's axis and mount, rad; of a link's length and a joint's place along each axis, m; of the
# tracked point along each axis, m; of gravity's direction, rad. What a careful assembly and a calliper give.
AXIS_TOLERANCE = 5e-4
LENGTH_TOLERANCE = 3e-4
TRACKED_POINT_TOLERANCE = 5e-4
GRAVITY_TOLERANCE = 1e-3


def perturbed(system: System, rng: np.random.Generator) -> System:
    """A system whose geometry differs from the described one by a draw from its tolerances.

    Of a planar system only what keeps it planar moves. Sizes and directions are drawn independently, from `rng`.
    """
    inside = np.array([1.0, 1.0, 0.0]) if system.motion == "planar" else np.ones(3)
    about = np.array([0.0, 0.0, 1.0]) if system.motion == "planar" else np.ones(3)

    def moved(point: tuple[float, float, float], tolerance: float) -> tuple[float, ...]:
        return _vector(np.array(point) + tolerance * inside * rng.standard_normal(3))

    def turned(joint: Joint) -> Joint:
        described = Rotation.from_rotvec(joint.mount_rotation)
        draw = Rotation.from_rotvec(AXIS_TOLERANCE * about * rng.standard_normal(3))
        return joint.model_copy(update={"mount_rotation": _vector((described * draw).as_rotvec())})

    def resized(link: RigidLink | FlexibleLink) -> RigidLink | FlexibleLink:
        if isinstance(link, RigidLink):
            return link.model_copy(update={"tip": moved(link.tip, LENGTH_TOLERANCE)})
        return link.model_copy(update={"length": link.length + LENGTH_TOLERANCE * rng.standard_normal()})

    update: dict[str, Any] = {
        "joints": tuple(turned(joint) for joint in system.joints),
        "links": tuple(resized(link) for link in system.links),
        "gravity": moved(system.gravity, GRAVITY_TOLERANCE * float(np.linalg.norm(system.gravity))),
    }
    if system.spacecraft is not None:
        point = moved(system.spacecraft.tracked_point, TRACKED_POINT_TOLERANCE)
        update["spacecraft"] = system.spacecraft.model_copy(update={"tracked_point": point})
    return system.model_copy(update=update)


def _vector(values: Array) -> tuple[float, ...]:
    return tuple(values.tolist())
