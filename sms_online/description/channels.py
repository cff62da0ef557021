"""Names of the channels that a capture of a system may hold, and what a sensor's patterns select of them."""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase

from sms_online.description.bodies import Deformation, FlexibleLink, Joint
from sms_online.description.schema import Sensor, System, Wrench, WrenchComponent

AXES = ("x", "y", "z")
WRENCH_COMPONENTS: tuple[WrenchComponent, ...] = ("f_x", "f_y", "f_z", "m_x", "m_y", "m_z")
# Nodal coordinates of a marker in the order of (32), with the deformation that moves each.
NODAL: dict[str, Deformation] = {
    "u_x": "traction",
    "u_y": "bending_z",
    "u_z": "bending_y",
    "theta_x": "torsion",
    "theta_y": "bending_y",
    "theta_z": "bending_z",
}


def is_directly_driven(joint: Joint) -> bool:
    """Whether the drive's force is measured at the axis: a prismatic axis, or no gear and a rigid transmission."""
    return joint.kind == "prismatic" or (joint.transmission == "rigid" and joint.gear_ratio == 1.0)


def has_motor_side(joint: Joint) -> bool:
    """Whether a joint has a θ_m apart from q; the spring of a passive joint acts between its parent and q."""
    return joint.transmission == "flexible" and not joint.passive


def drive_channels(system: System) -> dict[str, int]:
    """Channels of all drives, joint by joint, with the number of the joint (from 1); a passive joint has none."""
    driven = (i for i, joint in enumerate(system.joints, start=1) if not joint.passive)
    return {drive_channel(system, i): i for i in driven}


def drive_channel(system: System, i: int) -> str:
    """Channel of the drive of joint i (from 1): `tau_i` at the motor shaft, N m, or `force_i` at the axis, N or N m."""
    return f"force_{i}" if is_directly_driven(system.joints[i - 1]) else f"tau_{i}"


def wrench_components(system: System, wrench: Wrench) -> tuple[WrenchComponent, ...]:
    """Components of a wrench that are measured."""
    if wrench.components:
        return wrench.components
    return ("f_x", "f_y", "m_z") if system.motion == "planar" else WRENCH_COMPONENTS


def wrench_channels(system: System) -> tuple[str, ...]:
    """Channels of all measured wrenches, `wrench_1.f_x`, …."""
    numbered = enumerate(system.wrenches, start=1)
    return tuple(f"wrench_{k}.{name}" for k, wrench in numbered for name in wrench_components(system, wrench))


def strain_channel(system: System, i: int) -> str | None:
    """Channel of the strain at the root of link i (from 1), as an angle, where it replaces the spring of joint i.

    A strip of which only one mode is described is a rigid link behind a flexible joint: the angle is q_i - θ_m_i. None
    where the joint is no such spring.
    """
    joint = system.joints[i - 1]
    bends = has_motor_side(joint) and joint.kind == "revolute"
    return f"link_{i}.strain_angle" if bends and not isinstance(system.links[i - 1], FlexibleLink) else None


def channels(system: System) -> tuple[str, ...]:
    """Every channel that a capture of this system may hold: drives, joints, base, markers link by link, wrenches."""
    joints = range(1, len(system.joints) + 1)
    names = list(drive_channels(system))
    names += [f"theta_m_{i}" for i in joints if has_motor_side(system.joints[i - 1])]
    names += [f"q_{i}" for i in joints]
    if system.spacecraft is not None:
        names += _base_channels(planar=system.motion == "planar")
    for i, link in enumerate(system.links, start=1):
        if isinstance(link, FlexibleLink):
            names += _link_channels(i, link, system.motion == "planar")
            continue
        names += point_channels(system, i)
        if i <= len(system.joints) and (strain := strain_channel(system, i)) is not None:
            names.append(strain)
    return (*names, *wrench_channels(system))


def point_channels(system: System, i: int) -> list[str]:
    """Positions of the markers of link i (from 1) in the laboratory's axes, marker by marker."""
    fields = AXES[:2] if system.motion == "planar" else AXES
    count = len(system.links[i - 1].points)
    return [f"link_{i}.marker_{j}.{field}" for j in range(1, count + 1) for field in fields]


def _base_channels(planar: bool) -> list[str]:
    """Pose and rates of S: inertial velocity and ω_0, and ω_0 in body axes as a gyro gives it."""
    linear, angular = (AXES[:2], AXES[2:]) if planar else (AXES, AXES)
    attitude = ["theta_0"] if planar else ["eps_x", "eps_y", "eps_z", "eta"]
    return (
        [f"r_S_{a}" for a in linear]
        + attitude
        + [f"v_S_{a}" for a in linear]
        + [f"omega_0_{a}" for a in angular]
        + [f"gyro_0_{a}" for a in angular]
    )


def _link_channels(i: int, link: FlexibleLink, planar: bool) -> list[str]:
    """Markers in link frame {i} and in the laboratory's axes, and the root's strain; an exact link also shortens.

    Markers whose places are stated are seen in the laboratory's axes alone.
    """
    exact = link.kinematics == "exact"
    local = [name for name, moved_by in NODAL.items() if moved_by in link.deformations or (exact and name == "u_x")]
    fields = ([] if link.markers else local) + list(AXES[:2] if planar else AXES)
    return [f"link_{i}.marker_{j}.{field}" for j in range(1, len(link.points) + 1) for field in fields] + [
        f"link_{i}.strain_angle"
    ]


def concerns(where: str, names: Iterable[str]) -> bool:
    """Whether a place, or one of several with commas between them, is one of some channels or a pattern of theirs."""
    return any(fnmatchcase(name, pattern) for pattern in where.split(", ") for name in names)


def channel_unit(system: System, channel: str) -> str:
    """SI unit of a channel of the system; "" for the parts of a quaternion."""
    name = channel.rpartition(".")[2]
    stem, _, number = name.rpartition("_")
    if stem in ("tau", "force", "q", "theta_m"):
        slides = system.joints[int(number) - 1].kind == "prismatic"
        if stem in ("tau", "force"):
            return "N" if slides else "N m"
        return "m" if slides else "rad"
    if channel.startswith("wrench_"):
        return "N" if stem == "f" else "N m"
    if name.startswith(("v_S", "omega", "gyro")):
        return "m/s" if name.startswith("v_S") else "rad/s"
    if name.startswith("eps") or name == "eta":
        return ""
    return "rad" if name.startswith(("theta", "strain")) else "m"


def sensed_channels(system: System, sensor: Sensor) -> tuple[str, ...]:
    """Channels of the system that a sensor's shell patterns select, in the order of `channels`."""
    return tuple(c for c in channels(system) if any(fnmatchcase(c, pattern) for pattern in sensor.channels))
