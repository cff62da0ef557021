"""Mistakes in what samples hold: units, signs and places of channels, each with what undoes it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sms_online.description.channels import channel_unit, drive_channels
from sms_online.description.schema import System
from sms_online.description.sources import LogSource
from sms_online.diagnosis.record import Segment
from sms_online.grouping import grouped
from sms_online.sample_faults import stuck_samples, wrapped_at
from sms_online.stream import Array, Mask

DEGREE = math.pi / 180.0
# How a log's description names the units that are confused with SI, with what a number in SI is then divided by.
CONFUSED = {"deg": DEGREE, "degree": DEGREE, "degrees": DEGREE, "mm": 1e-3, "millimeter": 1e-3, "millimetre": 1e-3}
# Values that repeat in runs of at least this length, most of which are equal, are those of a held command.
HELD_RUN, MOST_RUNS = 3, 0.8
# A reading that moves by less than this share of what it usually does is at rest.
AT_REST = 0.2


@dataclass(frozen=True)
class MistakeHypothesis:
    """The hypothesis of one mistake, and how to correct it.

    name, where: its kind and place. sentence: what is wrong. step: what to do. apply: gives samples (B, channels)
    without it. system: the description without it, where it is one of that. certain: whether samples leave no doubt.
    """

    name: str
    where: str
    sentence: str
    step: str
    apply: Callable[[tuple[str, ...], Array], Array]
    system: Callable[[System], System] | None = None
    certain: bool = False


def shown(channels: Sequence[str], segments: Sequence[Segment]) -> Iterator[MistakeHypothesis]:
    """What samples of some channels show by themselves: encoders wrapped or stuck, steps of a held command."""
    drives = [c for c in channels if _is_drive(c)]
    positions = _positions(channels)
    stuck = list(_stuck(positions, channels, segments))
    yield from stuck
    # Where a stuck encoder goes on it jumps, too.
    places = [each.where for each in stuck]
    yield from _wrapped([c for c in positions if c not in places], channels, segments)
    yield from _held(drives, channels, segments)


def _is_drive(channel: str) -> bool:
    return channel.startswith(("tau_", "force_"))


def _positions(channels: Sequence[str]) -> list[str]:
    return [c for c in channels if not (_is_drive(c) or c.startswith("wrench_"))]


def mistake_hypotheses(system: System, channels: Sequence[str]) -> Iterator[MistakeHypothesis]:
    """What may be wrong with samples of some channels, but for scales of torques."""
    positions = _positions(channels)
    yield from _signs(positions)
    yield from _units(system, positions)
    yield from _converted_twice(system, positions)
    yield from _geared(system, channels)
    yield from _counts(channels)
    yield from _swaps(channels)


def torque_mistakes(system: System, joints: Sequence[int]) -> Iterator[tuple[float, MistakeHypothesis]]:
    """What torques of some joints, by index, may be in place of what they should, with the factor that undoes it."""
    drives = {i - 1: name for name, i in drive_channels(system).items()}
    names = [drives[i] for i in joints]
    gears = {system.joints[i].gear_ratio for i in joints}
    listed, where = _listed(names), ", ".join(names)
    unit = "N" if all(system.joints[i].kind == "prismatic" for i in joints) else "N m"
    look, are = ("look", "are") if len(names) > 1 else ("looks", "is")
    causes = [
        (-1.0, "torque_sign", f"the sign of {listed} is inverted", f"invert the sign of {listed}"),
        (1e-3, "torque_unit", f"{listed} {look} like m{unit} in place of {unit}", f"divide {listed} by 1000"),
        (1e3, "torque_unit", f"{listed} {look} like k{unit} in place of {unit}", f"multiply {listed} by 1000"),
    ]
    if len(gears) == 1 and gears != {1.0} and names[0].startswith("tau"):
        (n,) = gears
        of = "the joint's torque in place of the motor shaft's"
        once = f"{listed} {are} divided by the gear ratio {n:g} twice"
        causes.append((1.0 / n, "joint_torque", f"{listed} {look} like {of}", f"divide {listed} by {n:g}"))
        causes.append((n, "joint_torque", once, f"multiply {listed} by {n:g}"))
    for factor, name, sentence, step in causes:
        if len(joints) == len(drives) and factor > 0.0:
            sentence = f"everything is {1.0 / factor:.3g} × its description: {sentence}"
        yield factor, MistakeHypothesis(name, where, sentence, step, scaled(names, factor))


def scaled(names: Sequence[str], factor: float) -> Callable[[tuple[str, ...], Array], Array]:
    """What multiplies samples of some channels."""

    def apply(channels: tuple[str, ...], values: Array) -> Array:
        out = values.copy()
        out[:, [channels.index(name) for name in names if name in channels]] *= factor
        return out

    return apply


def _per_channel(names: Sequence[str], change: Callable[[Array], Array]) -> Callable[[tuple[str, ...], Array], Array]:
    """What changes the numbers of each of some channels."""

    def apply(channels: tuple[str, ...], values: Array) -> Array:
        out = values.copy()
        for name in names:
            if name in channels:
                k = channels.index(name)
                read = np.flatnonzero(np.isfinite(values[:, k]))
                out[read, k] = change(values[read, k])
        return out

    return apply


def _groups(names: Sequence[str]) -> dict[str, list[str]]:
    """Channels that one device gives: a link's markers, the base's position; every encoder is its own."""

    def device(name: str) -> str:
        return f"{name.partition('.')[0]}.*" if "." in name else "r_S_*" if name.startswith("r_S_") else name

    return grouped((device(name), name) for name in names)


def _encoders(channels: Sequence[str]) -> dict[str, list[str]]:
    """Channels of the encoders of each joint, by its number."""
    return grouped((name.rpartition("_")[2], name) for name in channels if name.startswith(("q_", "theta_m_")))


def _signs(positions: Sequence[str]) -> Iterator[MistakeHypothesis]:
    single = {name: [name] for name in positions if not name.startswith("e")}
    parts = [(*name.rpartition("_"), name) for name in positions]
    joints = grouped((f"q_{i}, theta_m_{i}", name) for kind, _, i, name in parts if kind in ("q", "theta_m"))
    both = {where: names for where, names in joints.items() if len(names) == 2}
    groups = {where: names for where, names in _groups(positions).items() if len(names) > 1}
    for where, names in {**single, **both, **groups}.items():
        if not where.startswith("e"):
            yield MistakeHypothesis(
                "angle_sign",
                where,
                f"the sign of {where} is inverted",
                f"invert the sign of {where}",
                scaled(names, -1.0),
            )


def _units(system: System, positions: Sequence[str]) -> Iterator[MistakeHypothesis]:
    angles, lengths = ([name for name in positions if channel_unit(system, name) == unit] for unit in ("rad", "m"))
    for name, text, factor, all_of, words in (
        ("degrees", "is in degrees in place of rad", DEGREE, angles, "all angles"),
        ("milliradians", "is in mrad in place of rad", 1e-3, angles, "all angles"),
        ("millimetres", "is in mm in place of m", 1e-3, lengths, "all lengths"),
    ):
        for where, names in {**{n: [n] for n in all_of}, **_groups(all_of)}.items():
            yield MistakeHypothesis(
                name, where, f"{where} {text}", f"multiply {where} by {factor:.4g}", scaled(names, factor)
            )
        if len(all_of) > 1:
            said = f"{words} {text.replace('is', 'are', 1)}"
            yield MistakeHypothesis(name, words, said, f"multiply them by {factor:.4g}", scaled(all_of, factor))


def _converted_twice(system: System, positions: Sequence[str]) -> Iterator[MistakeHypothesis]:
    """Numbers of a log that are in SI, described as in degrees or millimetres."""
    stated: dict[str, list[str]] = {}
    for source in system.sources:
        for signal in source.signals.values() if isinstance(source, LogSource) else ():
            if signal.unit in CONFUSED and signal.channel in positions:
                stated.setdefault(signal.unit, []).append(signal.channel)
    for unit, names in stated.items():
        factor = 1.0 / CONFUSED[unit]
        for where, group in {**{name: [name] for name in names}, **_groups(names)}.items():
            own = channel_unit(system, group[0])
            said = f"{where} is in {own}, where the system file states {unit}"
            then = f'state unit = "{own}" for {where}, or multiply by {factor:.4g} what was read'
            yield MistakeHypothesis("converted", where, said, then, scaled(group, factor))


def _geared(system: System, channels: Sequence[str]) -> Iterator[MistakeHypothesis]:
    """Encoders at the motor's shaft that no source takes through the gear, and those that one does though they are not.

    Of a joint with one encoder that is q_i, wherever it is mounted.
    """
    stated = {
        signal.channel
        for source in system.sources
        for signal in (source.signals.values() if isinstance(source, LogSource) else ())
        if signal.gear != 1.0
    }
    for i, joint in enumerate(system.joints, start=1):
        n = joint.gear_ratio
        for name in (f"theta_m_{i}", f"q_{i}"):
            if name not in channels or n == 1.0:
                continue
            if name in stated:
                said = f"{name} is divided by the gear ratio {n:g} twice"
                then = f"leave the gear out of its source, or multiply {name} by {n:g}"
                yield MistakeHypothesis("motor_angle", name, said, then, scaled([name], n))
            else:
                said = f"{name} is the motor's angle before the gear, {n:g} × the angle after it"
                yield MistakeHypothesis("motor_angle", name, said, f"divide {name} by {n:g}", scaled([name], 1.0 / n))


def _counts(channels: Sequence[str]) -> Iterator[MistakeHypothesis]:
    """Encoders of other counts a turn, as quadrature counts twice or four times, or behind another gear."""
    joints = _encoders(channels)
    single = [[name] for names in joints.values() for name in names]
    for names in (*single, *(names for names in joints.values() if len(names) == 2)):
        where = ", ".join(names)
        for times, words in ((4.0, "4 ×"), (2.0, "twice"), (0.5, "half"), (0.25, "a quarter of")):
            said = f"{where} reads {words} the angle: counts a turn, or the gear of its source"
            then = f"check counts and gear of {where}, or multiply it by {1.0 / times:g}"
            yield MistakeHypothesis("counts", where, said, then, scaled(names, 1.0 / times))


def _swaps(channels: Sequence[str]) -> Iterator[MistakeHypothesis]:
    kinds: dict[tuple[str, ...], list[str]] = {}
    for name in channels:
        stem, _, number = name.rpartition("_")
        if number.isdigit() or stem == "r_S":
            kinds.setdefault((stem,), []).append(name)
        if "." in name:
            kinds.setdefault((name.split(".")[0], name.rpartition(".")[2]), []).append(name)
    pairs = [([a], [b]) for names in kinds.values() for a, b in combinations(names, 2)]
    for name in channels:
        if name.startswith("q_") and f"theta_m_{name[2:]}" in channels:
            pairs.append(([name], [f"theta_m_{name[2:]}"]))
    markers = grouped((name.rpartition(".")[0], name) for name in channels if ".marker_" in name)
    for (a, first), (b, second) in combinations(markers.items(), 2):
        if len(first) == len(second) and a.split(".")[0] == b.split(".")[0]:
            pairs.append((first, second))
    links = grouped((marker.partition(".")[0], name) for marker, own in markers.items() for name in own)
    for first, second in combinations(links.values(), 2):
        if len(first) == len(second):
            pairs.append((first, second))
    for one, other in pairs:
        where, both = f"{_common(one)}, {_common(other)}", f"{_common(one)} and {_common(other)}"
        yield MistakeHypothesis("swapped", where, f"{both} are swapped", f"swap {both}", _swapped(one, other))
    yield from _swapped_axes(channels)


def _swapped_axes(channels: Sequence[str]) -> Iterator[MistakeHypothesis]:
    """Joints whose encoders are swapped, where each has two, and joints of which all is."""
    joints = _encoders(channels)
    drives = {name.rpartition("_")[2]: name for name in channels if _is_drive(name)}
    for (i, first), (j, second) in combinations(joints.items(), 2):
        if len(first) != len(second):
            continue
        if len(first) == 2:
            said = f"the encoders of joint_{i} and joint_{j} are swapped"
            where = ", ".join((*first, *second))
            yield MistakeHypothesis("swapped", where, said, "swap both encoders", _swapped(first, second))
        if i in drives and j in drives:
            said, where = f"all channels of joint_{i} and joint_{j} are swapped", f"joint_{i}, joint_{j}"
            one, other = [drives[i], *first], [drives[j], *second]
            yield MistakeHypothesis("swapped", where, said, "check the order of the axes", _swapped(one, other))


def _common(names: Sequence[str]) -> str:
    if len(names) == 1:
        return names[0]
    owners = {name.rpartition(".")[0] for name in names}
    return f"{owners.pop()}.*" if len(owners) == 1 else f"{names[0].partition('.')[0]}.*"


def _swapped(one: Sequence[str], other: Sequence[str]) -> Callable[[tuple[str, ...], Array], Array]:
    def apply(channels: tuple[str, ...], values: Array) -> Array:
        out = values.copy()
        a, b = ([channels.index(name) for name in names if name in channels] for names in (one, other))
        if len(a) == len(b):
            out[:, a], out[:, b] = values[:, b], values[:, a]
        return out

    return apply


def _wrapped(
    positions: Sequence[str], channels: Sequence[str], segments: Sequence[Segment]
) -> Iterator[MistakeHypothesis]:
    for name in positions:
        k = list(channels).index(name)
        wrapped = wrapped_at(np.concatenate([np.diff(each.values[:, k]) for each in segments]))
        if wrapped is not None:
            turn, times = wrapped
            said = f"{name} is wrapped at {turn:.4g}: it jumps {times} times"
            yield MistakeHypothesis(
                "wrapped", name, said, f"state wrap for {name}, or unwrap it", _unwrapped(name, turn)
            )


def _beside(name: str, positions: Sequence[str]) -> list[str]:
    """The joint's other encoder, or all other readings where it has none."""
    other = other_encoder(name)
    return [other] if other in positions else [each for each in positions if each != name]


def other_encoder(name: str) -> str:
    """The channel of the joint's encoder on the other side of its spring."""
    kind, _, joint = name.rpartition("_")
    return f"theta_m_{joint}" if kind == "q" else f"q_{joint}"


def _unwrapped(name: str, turn: float) -> Callable[[tuple[str, ...], Array], Array]:
    """Whole turns that wrapping loses are those of the joint's other encoder."""
    other, joined = other_encoder(name), _per_channel([name], lambda column: np.unwrap(column, period=turn))

    def apply(channels: tuple[str, ...], values: Array) -> Array:
        out = joined(channels, values)
        if name in channels and other in channels:
            k = channels.index(name)
            apart = out[:, k] - values[:, channels.index(other)]
            known = apart[np.isfinite(apart)]
            out[:, k] -= turn * np.round(np.median(known) / turn) if known.size else 0.0
        return out

    return apply


def _stuck(
    positions: Sequence[str], channels: Sequence[str], segments: Sequence[Segment]
) -> Iterator[MistakeHypothesis]:
    for name in positions:
        k = list(channels).index(name)
        stuck = [stuck_samples(each.values[:, k]) for each in segments]
        others = [list(channels).index(other) for other in _beside(name, positions)]
        if any(each.any() for each in stuck) and _moves(stuck, [each.values[:, others] for each in segments]):
            count = sum(int(each.sum()) for each in stuck)
            said = f"{name} is stuck at one value for {count} samples while it moves before"
            step = f"check encoder and cable of {name}; leave that time out with -ss and -to"
            # The joint's other encoder moves meanwhile, if there is one.
            yield MistakeHypothesis(
                "stuck", name, said, step, _per_channel([name], _without_stuck), certain=bool(others)
            )


def _moves(when: Sequence[Mask], readings: Sequence[Array]) -> bool:
    """Whether any of some readings (B, c) of segments moves at times (B,): else the arm is at rest."""
    speed = np.concatenate([np.abs(np.diff(each, axis=0, prepend=each[:1])) for each in readings])
    then = np.concatenate(when)
    return not speed.shape[1] or bool(np.any(speed[then].mean(axis=0) > AT_REST * speed.mean(axis=0)))


def _without_stuck(column: Array) -> Array:
    return np.where(stuck_samples(column), np.nan, column)


def without_gaps(segment: Segment) -> list[Segment]:
    """The parts of a segment whose samples are all numbers."""
    known = np.all(np.isfinite(segment.values), axis=1)
    edges = np.flatnonzero(np.diff(known)) + 1
    parts = zip(np.split(segment.index, edges), np.split(segment.values, edges), np.split(known, edges), strict=True)
    return [Segment(index, values) for index, values, fine in parts if fine[0]]


def _held(drives: Sequence[str], channels: Sequence[str], segments: Sequence[Segment]) -> Iterator[MistakeHypothesis]:
    """A command that is held between its updates: joined by lines from the start of each hold to the next."""
    lengths = {}
    for name in drives:
        k = list(channels).index(name)
        runs = np.concatenate(
            [np.diff(np.flatnonzero(np.diff(each.values[:, k]) != 0.0)) for each in segments] or [np.zeros(0)]
        )
        if runs.size > 2:
            most = int(np.median(runs))
            if most >= HELD_RUN and np.mean(runs % most == 0) > MOST_RUNS:
                lengths[name] = most
    if lengths:
        names = list(lengths)
        where = ", ".join(names)
        samples = ", ".join(str(each) for each in sorted(set(lengths.values())))
        said = f"{where} changes every {samples} samples only: a command that is held, no measured torque"
        step = f"record the measured torque or current for {where}"
        yield MistakeHypothesis("held_command", where, said, step, _per_channel(names, _joined))


def _joined(column: Array) -> Array:
    """Straight lines between the held values, each at the start of its hold."""
    starts = np.concatenate(([0], np.flatnonzero(np.diff(column) != 0.0) + 1))
    return np.interp(np.arange(column.size), starts, column[starts])


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
