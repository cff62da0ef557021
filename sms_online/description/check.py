"""Checks across records: sizes that have to agree, names that have to exist, physics that has to be possible."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from fnmatch import fnmatchcase

import numpy as np

from sms_online.description.bodies import Deformation, FlexibleLink, Inertia, Joint, Motor, RigidLink
from sms_online.description.channels import channels, sensed_channels, wrench_components
from sms_online.description.check_sources import check_sources
from sms_online.description.check_tree import check_tips, check_tree
from sms_online.description.explain import expected_channel, hint, nearest, quoted
from sms_online.description.schema import System
from sms_online.errors import InputError

# A direction that is typed with ten decimals is a unit vector to 1e-10.
UNIT_TOLERANCE = 1e-9
# What rounding of typed inertias, four digits or more, may leave of a principal moment that is impossible, relative to
# the largest.
INERTIA_TOLERANCE = 1e-9
TRIANGLE_TOLERANCE = 1e-3

# Positions of joints, rotors and nodes. The regressor of a step holds their products with every parameter: 264 of them
# (four links of 32 elements) take 290 MB to set up, 520 take 880 MB.
MOST_COORDINATES = 256
# Samples under a test function. The covariance of all pairs of them is computed: 8 bytes each, 540 MB here.
MOST_SAMPLES = 8192

RIGIDITY: dict[Deformation, str] = {
    "traction": "axial_rigidity",
    "torsion": "torsional_rigidity",
    "bending_y": "flexural_rigidity_y",
    "bending_z": "flexural_rigidity_z",
}
# kind@place.coefficient for a declared effect, or owner.quantity
PARAMETER_NAME = re.compile(r"(?P<owner>[^\s@]+(@\S+)?)\.(?P<quantity>[a-z][a-z0-9_]*)")


def check_system(system: System, source: str) -> None:
    """Raise InputError at the first contradiction in a description."""
    if not system.name:
        raise InputError(source, "name", "an empty text", "a name")
    _check_size(system, source)
    check_tree(system, source)
    for i, (joint, motor) in enumerate(zip(system.joints, system.motors, strict=True), start=1):
        _check_joint(i, joint, motor, system.motion == "planar", source)
    for i, link in enumerate(system.links, start=1):
        if isinstance(link, FlexibleLink):
            _check_flexible(f"link_{i}", link, system.motion == "planar", source)
        _check_markers(f"link_{i}", link, source)
    check_tips(system, source)
    for place, inertia in _inertias(system):
        _check_inertia(place, inertia, system.motion == "planar", source)
    if system.motion == "planar" and system.gravity[2] != 0.0:
        raise InputError(
            source, "gravity", f"{system.gravity[2]:g} m/s² along z", "gravity in the x-y plane, or motion = 'spatial'"
        )
    _check_simulation(system, source)
    names = channels(system)
    _check_wrenches(system, source)
    _check_sensors(system, names, source)
    check_sources(system, names, source)
    _check_effects(system, names, source)
    _check_parameter_names(system, source)


def _check_size(system: System, source: str) -> None:
    """What would fill the memory before it estimates anything."""
    coordinates = sum(1 + (joint.transmission == "flexible") for joint in system.joints)
    for link in system.links:
        if isinstance(link, FlexibleLink):
            coordinates += link.elements * sum(2 if name.startswith("bending") else 1 for name in link.deformations)
    if coordinates > MOST_COORDINATES:
        found = f"{coordinates} positions of joints, rotors and nodes"
        raise InputError(source, "", found, f"{MOST_COORDINATES} at most: fewer joints, or fewer elements of a link")
    width = max(system.windows.relative, system.windows.momentum)
    if system.sample_rate * width > MOST_SAMPLES:
        expected = f"{MOST_SAMPLES / width:g} Hz at most, for a window of {width:g} s has no more than {MOST_SAMPLES}"
        raise InputError(source, "sample_rate", f"{system.sample_rate:g} Hz", expected)


def _check_joint(i: int, joint: Joint, motor: Motor | None, planar: bool, source: str) -> None:
    place = f"joint_{i}"
    length = math.hypot(*joint.axis)
    if abs(length - 1.0) > UNIT_TOLERANCE:
        found, unit = (
            f"{list(joint.axis)} of length {length:.10g}",
            [round(a / (length or 1.0), 12) for a in joint.axis],
        )
        expected = f"a unit vector, {unit}" if length > 0.0 else "a unit vector, for an axis has a direction"
        raise InputError(source, f"{place}.axis", found, expected)
    if joint.passive:
        if motor is not None:
            raise InputError(source, f"motor_{i}", f"a motor at {place}, which is passive", "no such table")
    elif joint.transmission == "flexible":
        if joint.stiffness == 0.0:
            raise InputError(source, f"{place}.stiffness", "0", "a stiffness greater than 0, or transmission = 'rigid'")
        if motor is None or motor.rotor_inertia == 0.0:
            found = "no such table" if motor is None else "0"
            raise InputError(
                source,
                f"motor_{i}.rotor_inertia",
                found,
                f"a rotor inertia greater than 0, for {place} has a flexible transmission",
            )
    if not planar:
        return
    if joint.kind == "revolute" and abs(joint.axis[2]) != 1.0:
        raise InputError(source, f"{place}.axis", f"{list(joint.axis)}", "[0, 0, 1] or [0, 0, -1] in planar motion")
    if joint.kind == "prismatic" and joint.axis[2] != 0.0:
        raise InputError(source, f"{place}.axis", f"{list(joint.axis)}", "an axis in the x-y plane in planar motion")


def _check_markers(place: str, link: FlexibleLink | RigidLink, source: str) -> None:
    """Markers sit on their link."""
    if isinstance(link, RigidLink):
        if link.markers and link.kind == "cross":
            raise InputError(source, f"{place}.markers", "markers on a cross", "none, for it has no body")
        return
    for j, marker in enumerate(link.markers, start=1):
        if not 0.0 <= marker.position[0] <= link.length:
            place, found = f"{place}.markers[{j}].position", f"x = {marker.position[0]:g} m"
            raise InputError(source, place, found, f"a station along the link, 0 to {link.length:g} m")


def _check_flexible(place: str, link: FlexibleLink, planar: bool, source: str) -> None:
    if len(set(link.deformations)) < len(link.deformations):
        raise InputError(source, f"{place}.deformations", f"{list(link.deformations)}", "each deformation once")
    if planar and (link.root_rotation[:2] != (0.0, 0.0) or link.root_position[2] != 0.0):
        expected = "a root in the x-y plane, turned about z alone, in planar motion"
        raise InputError(source, place, f"{list(link.root_position)}, {list(link.root_rotation)}", expected)
    if planar and link.deformations != ("bending_z",):
        raise InputError(
            source, f"{place}.deformations", f"{list(link.deformations)}", "['bending_z'] in planar motion"
        )
    if link.kinematics == "exact" and "traction" in link.deformations:
        raise InputError(
            source, f"{place}.deformations", "'traction'", "no traction on an inextensible link (kinematics = 'exact')"
        )
    for deformation in link.deformations:
        rigidity = RIGIDITY[deformation]
        if getattr(link, rigidity) == 0.0:
            raise InputError(
                source, f"{place}.{rigidity}", "0", f"a rigidity greater than 0, for {deformation} is active"
            )
    if "torsion" in link.deformations and link.polar_inertia_per_length == 0.0:
        raise InputError(
            source,
            f"{place}.polar_inertia_per_length",
            "0",
            "an inertia greater than 0, for without it torsion has no mass",
        )


def _inertias(system: System) -> Iterable[tuple[str, Inertia]]:
    if system.spacecraft is not None:
        yield "spacecraft.inertia", system.spacecraft.inertia
    for i, motor in enumerate(system.motors, start=1):
        if motor is not None:
            yield f"motor_{i}.stator_inertia", motor.stator_inertia
    for i, link in enumerate(system.links, start=1):
        if isinstance(link, RigidLink):
            yield f"link_{i}.inertia", link.inertia
    if system.payload is not None:
        yield "payload.inertia", system.payload.inertia


def _check_inertia(place: str, inertia: Inertia, planar: bool, source: str) -> None:
    """Principal moments that some body has; in the plane, where only one is stated, not more than its sign."""
    i = inertia
    moments = np.linalg.eigvalsh([[i.xx, i.xy, i.xz], [i.xy, i.yy, i.yz], [i.xz, i.yz, i.zz]])
    if moments[0] < -INERTIA_TOLERANCE * moments[2]:
        raise InputError(
            source, place, f"a negative principal moment, {moments[0]:.3g} kg m²", "a body's inertia: none below 0"
        )
    if not planar and moments[2] - moments[0] - moments[1] > TRIANGLE_TOLERANCE * moments[2]:
        found = f"principal moments {', '.join(f'{moment:.5g}' for moment in moments)} kg m²"
        raise InputError(source, place, found, "a body's inertia: none above the sum of the other two")


def _check_simulation(system: System, source: str) -> None:
    n = len(system.joints)
    if system.controller is not None:
        for key, gains in (("stiffness", system.controller.stiffness), ("damping", system.controller.damping)):
            if len(gains) != n:
                raise InputError(
                    source,
                    f"controller.{key}",
                    f"{len(gains)} value{'s' * (len(gains) != 1)}",
                    f"{n}, one for each joint",
                )
            for i, (joint, gain) in enumerate(zip(system.joints, gains, strict=True), start=1):
                if joint.passive and gain > 0.0:
                    raise InputError(source, f"controller.{key}", f"{gain:g} of joint_{i}", "0, for it is passive")


def _check_wrenches(system: System, source: str) -> None:
    """Each acts on a body that there is, with components that the motion has."""
    bodies = [f"link_{i}" for i in range(1, len(system.links) + 1)]
    bodies += [] if system.spacecraft is None else ["base"]
    for k, wrench in enumerate(system.wrenches, start=1):
        if wrench.where not in bodies:
            raise InputError(source, f"wrench {k}.where", repr(wrench.where), quoted(bodies))
        components = wrench_components(system, wrench)
        whole = wrench_components(system, wrench.model_copy(update={"components": ()}))
        for place, names in (("components", components), ("applied", (*wrench.applied,))):
            if other := [name for name in names if name not in (components if place == "applied" else whole)]:
                expected = quoted(components if place == "applied" else whole)
                raise InputError(source, f"wrench {k}.{place}", repr(other[0]), expected)
        if len(set(components)) < len(components):
            raise InputError(source, f"wrench {k}.components", "the same one twice", "each of them once")


def _check_sensors(system: System, names: tuple[str, ...], source: str) -> None:
    filled: dict[str, int] = {}
    for k, sensor in enumerate(system.sensors, start=1):
        for pattern in sensor.channels:
            if not sensed_channels(system, sensor.model_copy(update={"channels": (pattern,)})):
                expected = expected_channel(pattern, names)
                raise InputError(source, f"sensor {k}.channels", f"{pattern!r} matches no channel", expected)
        sensed = sensed_channels(system, sensor)
        if sensor.hold and (other := [name for name in sensed if not name.startswith(("tau_", "force_"))]):
            raise InputError(source, f"sensor {k}.hold", f"true for {other[0]!r}", "hold of torques and forces alone")
        for channel in sensed:
            if channel in filled:
                raise InputError(
                    source,
                    f"sensor {k}.channels",
                    f"{channel!r} is filled by sensor {filled[channel]} too",
                    "one sensor for a channel",
                )
            filled[channel] = k


def _numbered(system: System) -> list[str]:
    """Joints that move, and links, as places and owners of parameters."""
    pairs = [f"{kind}_{i}" for i in range(1, len(system.joints) + 1) for kind in ("joint", "link")]
    return pairs + [f"link_{i}" for i in range(len(system.joints) + 1, len(system.links) + 1)]


def _check_effects(system: System, names: tuple[str, ...], source: str) -> None:
    """Places and repetitions; which effects there are and with what coefficients, the effects' catalogue says."""
    places = ("base", *_numbered(system), "tip")
    seen: set[str] = set()
    for k, effect in enumerate(system.effects, start=1):
        if not any(fnmatchcase(name, effect.where) for name in (*places, *names)):
            near = nearest(effect.where, (*places, *names))
            raise InputError(
                source,
                f"effect {k}.where",
                repr(effect.where),
                f"{', '.join(places)}, a channel or a pattern of channels{hint(near)}",
            )
        if effect.key in seen:
            raise InputError(source, f"effect {k}", f"{effect.key} again", "each effect once at a place")
        seen.add(effect.key)


def _check_parameter_names(system: System, source: str) -> None:
    """`known`, `prior` and `fitted`: the owner exists; whether it has the quantity, the model says."""
    owners = [] if system.spacecraft is None else ["spacecraft"]
    owners += _numbered(system)
    owners += [f"motor_{i}" for i, motor in enumerate(system.motors, start=1) if motor is not None]
    owners += ["payload"] if system.payload is not None else []
    owners += [effect.key for effect in system.effects]
    for table, parameters in (("known", system.known), ("prior", system.priors), ("fitted", system.fitted)):
        for name in parameters:
            parts = PARAMETER_NAME.fullmatch(name)
            if parts is None:
                raise InputError(source, table, repr(name), "the name of a parameter, such as 'motor_1.mass'")
            if parts["owner"] not in owners:
                raise InputError(
                    source,
                    f'{table}."{name}"',
                    f"{parts['owner']!r} is not in this system",
                    quoted(owners, nearest(parts["owner"], owners)),
                )
    for name in system.known:
        if name in system.priors:
            raise InputError(source, f'prior."{name}"', "a parameter that is in [known] too", "one of the two")
