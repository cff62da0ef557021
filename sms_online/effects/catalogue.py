"""All effects by name: what may be declared where, and from declarations to effects.

A further effect is a class with an `entry`, listed in FORCES, INERTIAS or CHANNELS.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatchcase
from itertools import pairwise

from sms_online.description.bodies import FlexibleLink
from sms_online.description.channels import channels, drive_channels, has_motor_side, strain_channel
from sms_online.description.explain import hint, nearest
from sms_online.description.schema import Effect, System
from sms_online.description.tree import index_of
from sms_online.effects.base import Constant, Entry, Place, Site
from sms_online.effects.channel import ChannelEffect, EncoderEccentricity, EncoderOffset, Linear
from sms_online.effects.coupled import CoupledFriction, CoupledInertia, GravitySpring
from sms_online.effects.delay import LONGEST_DELAY, ActuatorDelay, SensorLag, SensorLatency, TorqueDelay
from sms_online.effects.drive import Cogging, TorqueGain, TorqueOffset, TorqueRipple
from sms_online.effects.friction import (
    BearingCoulombFriction,
    BearingViscousFriction,
    CoulombFriction,
    DirectionFriction,
    LoadFriction,
    PreslidingFriction,
    StribeckFriction,
    ViscousFriction,
)
from sms_online.effects.learned import LearnedForce
from sms_online.effects.link import SEPARATED_BY, LinkDamping, LinkMassDamping
from sms_online.effects.payload import TipPayload
from sms_online.effects.spacecraft import (
    AirDrag,
    CableSpring,
    ReactionWheel,
    RotationalDrag,
    Slosh,
    TableTilt,
    ThrusterLeak,
)
from sms_online.effects.traits import Traits
from sms_online.effects.transmission import Backlash, CubicStiffness, KinematicError, TorsionalHysteresis
from sms_online.errors import InputError
from sms_online.model.effect import ForceEffect, InertiaEffect

FORCES = (
    CoulombFriction, ViscousFriction, StribeckFriction, PreslidingFriction, LoadFriction, DirectionFriction,
    TorsionalHysteresis, CubicStiffness, Backlash, KinematicError, Cogging, TorqueRipple, LinkDamping, LinkMassDamping,
    ReactionWheel, ThrusterLeak, TableTilt, AirDrag, RotationalDrag, CableSpring, Slosh, TorqueGain, TorqueOffset,
    CoupledFriction, GravitySpring, BearingViscousFriction, BearingCoulombFriction, LearnedForce,
)  # fmt: skip
CHANNELS = (EncoderOffset, EncoderEccentricity, SensorLag, TorqueDelay, ActuatorDelay)
INERTIAS = (TipPayload, CoupledInertia)
CLASSES = (*FORCES, *INERTIAS, *CHANNELS)
_CLASSES: tuple[type[object], ...] = CLASSES  # of one type, of which some are constants
# The step from `linear` to `exact` kinematics of a link; it has no coefficients and no class.
GEOMETRIC_STIFFENING = Entry("geometric_stiffening", "kinematics", "linear link", {}, SEPARATED_BY)

ENTRIES: dict[str, Entry] = {entry.name: entry for entry in (*(each.entry for each in CLASSES), GEOMETRIC_STIFFENING)}
NAMES = tuple(ENTRIES)
# Built from a site and the declared coefficients, or from a channel (or pattern) and these.
FORCE_CLASSES: dict[str, Callable[[Site, Mapping[str, float]], ForceEffect]] = {
    each.entry.name: each for each in FORCES
}
INERTIA_CLASSES: dict[str, Callable[[Site, Mapping[str, float]], InertiaEffect]] = {
    each.entry.name: each for each in INERTIAS
}
_CHANNELS: dict[str, Callable[[str, Mapping[str, float]], ChannelEffect]] = {each.entry.name: each for each in CHANNELS}
# Linear coefficients of those on channels, and what becomes a constant of the description.
LINEAR: dict[str, tuple[Linear, ...]] = {each.entry.name: each.linear for each in CHANNELS}
CONSTANTS: dict[str, type[Constant]] = {each.entry.name: each for each in _CLASSES if issubclass(each, Constant)}
# Numbers of joints below this are one character of a pattern.
TEN = 10
# Fewest knots of a curve, two of them its ends; and variables of joints with a spring.
LEAST_KNOTS = 3
OF_SPRINGS = ("deflection", "load")
# Tried at any joint where something changes while a session runs.
BEGINNING = tuple(sorted(entry.name for entry in ENTRIES.values() if entry.traits.begins))


def declares(tolerance: str) -> str:
    """Name of the first effect whose declaration says what a field of `Tolerances` allows for."""
    return next(name for name, entry in ENTRIES.items() if tolerance in entry.traits.calibrates)


def places(system: System, at: Place) -> tuple[str, ...]:
    """Where effects of a kind of place may sit in a system; for channels, the channels."""
    joints = [f"joint_{i}" for i in range(1, len(system.joints) + 1)]
    driven = tuple(f"joint_{i}" for i in drive_channels(system).values())
    turning = [name for name, joint in zip(joints, system.joints, strict=True) if joint.kind == "revolute"]
    flexible = [(f"link_{i}", k) for i, k in enumerate(system.links, start=1) if isinstance(k, FlexibleLink)]
    match at:
        case "joint":
            return tuple(joints)
        case "driven joint":
            return driven
        case "later joint":
            return tuple(name for name in driven if name != joints[0])
        case "joint pair":
            # In a plane the sum of two rates is a link's own. No shaft runs through a link that bends.
            stiff = [k for k, link in enumerate(system.links, start=1) if not isinstance(link, FlexibleLink)]
            pairs = [(f"joint_{i}", f"joint_{i + 1}") for i in stiff] if system.motion == "spatial" else []
            return tuple("+".join(pair) for pair in pairs if set(pair) <= set(driven) & set(turning))
        case "weighed joint":
            return tuple(turning) if any(system.gravity) else ()
        case "flexible joint":
            return tuple(n for n, j in zip(joints, system.joints, strict=True) if has_motor_side(j))
        case "link":
            return tuple(name for name, _ in flexible)
        case "linear link":
            return tuple(n for n, k in flexible if k.kinematics == "linear" and "traction" not in k.deformations)
        case "base":
            return () if system.spacecraft is None else ("base",)
        case "tip":
            return ("tip",)
        case "angle":
            revolute = [j.kind == "revolute" for j in system.joints]
            names = [f"{kind}_{i}" for i, turns in enumerate(revolute, start=1) if turns for kind in ("q", "theta_m")]
            return tuple(c for c in channels(system) if c in names)
        case "position":
            drives = drive_channels(system)
            return tuple(c for c in channels(system) if c not in drives and not c.startswith(("v_S", "omega", "gyro")))


def declarable(entry: Entry, system: System) -> dict[str, str]:
    """Coefficients and shape constants that may be declared in a system, name to unit; some differ with its motion."""
    names = {**entry.coefficients, **entry.further, **{name: shape.unit for name, shape in entry.shapes.items()}}
    if entry.at == "base":
        for name in PLANAR_LACKS if system.motion == "planar" else SPATIAL_LACKS:
            names.pop(name, None)
    return names


PLANAR_LACKS = ("torque_x", "torque_y", "torque_z", "force_z", "rest_z")
SPATIAL_LACKS = ("torque",)


def check_effect(system: System, effect: Effect, place: str, source: str) -> None:
    """InputError (source, place) on an unknown name, place, coefficient, or a shape constant that is not positive."""
    if effect.name not in ENTRIES:
        expected = f"one of {', '.join(NAMES)}{hint(nearest(effect.name, NAMES))}"
        raise InputError(source, place, f"unknown effect {effect.name!r}", expected)
    entry = ENTRIES[effect.name]
    allowed = places(system, entry.at)
    matching = fnmatchcase if entry.kind == "channel" else str.__eq__
    if not any(matching(each, effect.where) for each in allowed):
        expected = f"one of {', '.join(allowed)}" if allowed else f"a system with a {entry.at}"
        raise InputError(source, place, f"{effect.name} at {effect.where!r}", expected)
    _check_curve(system, effect, place, source)
    known = declarable(entry, system)
    for name, value in effect.coefficients.items():
        if name not in known:
            expected = " or ".join(repr(k) for k in known) if known else "none"
            raise InputError(source, place, f"coefficient {name!r} of {effect.name}", expected)
        if name in entry.shapes and value <= 0.0 < entry.shapes[name].default:
            raise InputError(source, place, f"{name} = {value:g} of {effect.name}", "a number greater than 0")
        if name == "time" and entry.kind == "channel" and not 0.0 <= value <= LONGEST_DELAY:
            raise InputError(source, place, f"{name} = {value:g} s of {effect.name}", f"0 to {LONGEST_DELAY:g} s")


def _check_curve(system: System, effect: Effect, place: str, source: str) -> None:
    """InputError on a variable or knots of what is no curve, or of one that cannot be."""
    over = ENTRIES[effect.name].over
    if not over:
        if effect.over is not None or effect.knots:
            raise InputError(source, place, f"over or knots of {effect.name}", "neither: it is a law")
        return
    if (effect.over is None) == bool(effect.knots):
        raise InputError(source, place, f"over or knots of {effect.name} without the other", "both, or neither")
    known = curve_variables(system, effect)
    if effect.over is not None and effect.over not in known:
        expected = f"one of {', '.join(known)}"
        raise InputError(source, place, f"{effect.name} over {effect.over!r} of {effect.where}", expected)
    if effect.knots and (len(effect.knots) < LEAST_KNOTS or any(b <= a for a, b in pairwise(effect.knots))):
        expected = f"{LEAST_KNOTS} or more, ascending"
        raise InputError(source, place, f"knots {list(effect.knots)} of {effect.name}", expected)


def curve_variables(system: System, effect: Effect) -> tuple[str, ...]:
    """What a curve of an effect may be over at its joint; one without a spring has neither deflection nor load."""
    joint = system.joints[index_of(effect.where)]
    return tuple(over for over in ENTRIES[effect.name].over if has_motor_side(joint) or over not in OF_SPRINGS)


def traits_of(effect: Effect) -> Traits:
    """Traits of an effect, those of its variable where it is a curve."""
    entry = ENTRIES[effect.name]
    return entry.traits if effect.over is None else entry.over[effect.over]


def with_shapes(effect: Effect, system: System) -> Effect:
    """The effect with defaults for shape constants that it does not declare."""
    entry = ENTRIES[effect.name]
    known = declarable(entry, system)
    shapes = {name: shape.default for name, shape in entry.shapes.items() if name in known}
    return effect.model_copy(update={"coefficients": shapes | effect.coefficients})


def parse_effect(text: str, system: System, source: str = "--effect") -> Effect:
    """Effect of `NAME@WHERE:coefficient=value,…`, coefficients optional; InputError on whatever is wrong with it.

    source: what takes the text, for messages.
    """
    head, _, tail = text.partition(":")
    name, at, where = head.partition("@")
    if not at:
        raise InputError(source, text, "no @", "NAME@WHERE:coefficient=value,…, such as coulomb_friction@joint_1")
    coefficients: dict[str, float] = {}
    for part in filter(None, tail.split(",")):
        key, _, number = (piece.strip() for piece in part.partition("="))
        try:
            value = float(number)
        except ValueError:
            value = float("nan")
        if not math.isfinite(value) or key in coefficients:
            found = f"{key!r} twice" if key in coefficients else repr(part)
            raise InputError(source, text, found, "coefficient=value with a finite number, each once")
        coefficients[key] = value
    effect = Effect(name=name, where=where, coefficients=coefficients)
    check_effect(system, effect, text, source)
    if any(other.key == effect.key for other in system.effects):
        raise InputError(source, text, f"{head} again", "each effect once at a place")
    return effect


def channel_effects(system: System) -> tuple[ChannelEffect, ...]:
    """Effects of kind channel that a system declares, in its order; InputError as `build_effects`."""
    out: list[ChannelEffect] = []
    for k, effect in enumerate(system.effects, start=1):
        if effect.name in _CHANNELS:
            check_effect(system, effect, f"effect {k}", system.name)
            entry = ENTRIES[effect.name]
            if not (entry.shapes or effect.coefficients):
                expected = f"{' and '.join(entry.coefficients)}, to correct the samples by"
                raise InputError(system.name, f"effect {k}", f"{effect.name} without coefficients", expected)
            out.append(_CHANNELS[effect.name](effect.where, with_shapes(effect, system).coefficients))
    return tuple(out)


def corrections(system: System) -> tuple[ChannelEffect, ...]:
    """Corrections of a system's channels: effects as declared, then latencies of sensors."""
    delays = [(sensor.channels, sensor.delay(system.sample_rate)) for sensor in system.sensors]
    return (*channel_effects(system), *(SensorLatency(channels, delay) for channels, delay in delays if delay != 0.0))


def candidates(system: System) -> list[Effect]:
    """Every effect that may be declared, at every place that makes sense, shape constants at their defaults.

    A lag is that of a whole group of channels, as the sensors' tables form them; an offset and an eccentricity are
    those of one encoder, an offset also that of a strain gauge. What the system declares already is left out.
    """
    declared = {effect.key for effect in system.effects}
    out = []
    for entry in ENTRIES.values():
        for where in _groups(system, entry) if entry.kind == "channel" else places(system, entry.at):
            if f"{entry.name}@{where}" not in declared:
                out.append(with_shapes(Effect(name=entry.name, where=where), system))
    return out


def lag_places(system: System) -> list[str]:
    """Channels, or patterns of channels, that may lag together; those that the system declares are left out."""
    return [effect.where for effect in candidates(system) if effect.name == SensorLag.entry.name]


def kinematic_candidates(system: System) -> list[Effect]:
    """What may be declared that changes the links' kinematics."""
    return [effect for effect in candidates(system) if ENTRIES[effect.name].kind == "kinematics"]


def periods(effect: Effect) -> float | None:
    """Periods that an effect has in a motor's turn, None where it has none."""
    counted = (name for name, shape in ENTRIES[effect.name].shapes.items() if shape.counted)
    return next((effect.coefficients[name] for name in counted if name in effect.coefficients), None)


def either(effect: Effect, system: System) -> str:
    """The place where as much the other way is the same; empty where an effect is of its own place alone."""
    return ENTRIES[effect.name].relative_to if system.scale_tolerance is not None else ""


def in_words(effect: Effect, system: System, coefficients: Mapping[str, float]) -> str:
    """An effect with these coefficients as a sentence; empty where the catalogue has none."""
    said, other = ENTRIES[effect.name].said, either(effect, system)
    if said is None:
        return ""
    words = said(effect.where, coefficients)
    return f"{words} against {other}'s: the data cannot decide which is right" if other else words


# Channels that come together, beside those of a link's markers; and those that one controller may read late.
DEVICES = ("r_S_*", "eps_*")
ENCODERS = ("q_*", "theta_m_*")


def _groups(system: System, entry: Entry) -> Iterable[str]:
    """Channels, or patterns of channels, that one cause is likely to act on together."""
    strips = [strain_channel(system, i) for i in range(1, len(system.joints) + 1)]
    gauges = [strip for strip in strips if strip is not None]
    if entry.name == EncoderOffset.entry.name:
        return (*places(system, "angle"), *gauges)
    if entry.name in (TorqueDelay.entry.name, ActuatorDelay.entry.name):
        # What one bus or one controller makes late, and each drive. Of a joint with one encoder it is that encoder's
        # lag where a torque acts late.
        flexible = entry.name == ActuatorDelay.entry.name
        drives = places(system, "flexible joint" if flexible else entry.at)
        drives = tuple(name for name in drives if name in places(system, entry.at))
        return ("joint_*", *drives) if len(drives) > 1 else drives
    if entry.name != SensorLag.entry.name:
        return places(system, entry.at)
    positions = places(system, "position")
    # What one device delivers: an encoder its angle, a tracker the base's position, a camera a link's markers.
    devices = [next((p for p in DEVICES if fnmatchcase(c, p)), c) for c in positions]
    links = [f"{c.split('.')[0]}.*" if "." in c and c not in gauges else c for c in devices]
    patterns = [pattern for sensor in system.sensors for pattern in sensor.channels]
    shared = [p for p in patterns if any(fnmatchcase(c, p) for c in positions)]
    shared += [p for p in ENCODERS if sum(fnmatchcase(c, p) for c in positions) > 1]
    # Encoders behind springs, where others sit on motors: they come from other electronics.
    second = [c.removeprefix("q_") for c in positions if c.startswith("q_") and f"theta_m_{c[2:]}" in positions]
    if 1 < len(second) < len(joints := [c for c in positions if c.startswith("q_")]) and len(joints) < TEN:
        shared.append(f"q_[{''.join(second)}]")
    return dict.fromkeys([*links, *shared])
