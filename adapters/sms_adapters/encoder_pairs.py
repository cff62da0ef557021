"""Gears in a description: do both encoders of a flexible joint turn alike, and do logs divide by its gear ratio?"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np

from sms_adapters.channel_check import Remark
from sms_online.description.bodies import Joint
from sms_online.description.schema import System
from sms_online.description.sources import LogSource
from sms_online.stream import Array

# From this correlation on two readings are of one motion: a spring that is as soft as its link is heavy leaves less.
SAME_MOTION = 0.95
# Both sides of a spring turn as far up to this factor; further apart they are in other units.
ALIKE = 2.0
# Ratios within this factor of a unit's or the gear's are explained by it: a spring changes them by less.
CLOSE = 1.5
# Both sides of a spring come apart by this multiple of what its described stiffness allows, and by a share of the angle
# that varies no more than so: the gear is another.
TOO_FAR, STEADY = 5.0, 0.1
# Samples of both before anything is said.
LEAST_SAMPLES = 100


class EncoderPair:
    """Sums over the samples that hold both readings of a joint, motor side and link side.

    motor, link: names of the channels, and numbers of their columns. torque: number of the column of the torque at the
    motor's shaft, None where there is none. joint: which both belong to.
    """

    def __init__(self, motor: tuple[str, int], link: tuple[str, int], torque: int | None, joint: Joint) -> None:
        self._names, self._columns = (motor[0], link[0]), [motor[1], link[1]]
        self._torque, self._joint = torque, joint
        self._torques, self._squares = 0, 0.0
        self._origin: Array | None = None
        self._count, self._sum, self._products = 0, np.zeros(2), np.zeros((2, 2))

    def push(self, values: Array) -> None:
        """Take samples of all channels (B, C)."""
        if self._torque is not None:
            torque = values[np.isfinite(values[:, self._torque]), self._torque]
            self._torques += torque.size
            self._squares += float(torque @ torque)
        both = values[:, self._columns]
        both = both[np.isfinite(both).all(axis=1)]
        if not len(both):
            return
        if self._origin is None:
            self._origin = both[0]
        moved = both - self._origin
        self._count += len(moved)
        self._sum = self._sum + moved.sum(axis=0)
        self._products = self._products + moved.T @ moved

    def remarks(self) -> Iterator[Remark]:
        """What is the matter, if something is."""
        if self._count < LEAST_SAMPLES:
            return
        covariance = self._products - np.outer(self._sum, self._sum) / self._count
        size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        if not size.all() or abs(covariance[0, 1]) < SAME_MOTION * size[0] * size[1]:
            return
        motor, link = self._names
        ratio = float(np.sign(covariance[0, 1]) * size[0] / size[1])
        if 1.0 / ALIKE < ratio < ALIKE:
            yield from self._gear(covariance / self._count)
            return
        far, near = (motor, link) if abs(ratio) >= 1.0 else (link, motor)
        turns = max(abs(ratio), 1.0 / abs(ratio))
        how = f"{turns:.2g} times as far as {near}" if turns > ALIKE else f"as far as {near}"
        seems = []
        if turns > ALIKE:
            units = " or ".join(self._units(far == motor, turns, near))
            seems.append(f"it is {units}" if units else "one of them is in another unit")
        if ratio < 0.0:
            how += ", the other way round"
            seems.append("one of them has the wrong sign")
        yield Remark(far, f"turns {how}: {', and '.join(seems)}", True)

    def _gear(self, covariance: Array) -> Iterator[Remark]:
        """A gear ratio that is another by less than a unit: what the spring's torque does not turn.

        covariance (2, 2): of motor and link.
        """
        motor, link = self._names
        stiffness, n = self._joint.stiffness, self._joint.gear_ratio
        if not self._torques or not stiffness:
            return
        ratio = float(covariance[0, 1] / covariance[1, 1])
        apart = abs(ratio - 1.0) * float(np.sqrt(covariance[1, 1]))
        rest = float(np.sqrt(max(0.0, covariance[0, 0] - ratio * covariance[0, 1])))
        allowed = n * float(np.sqrt(self._squares / self._torques)) / stiffness
        if apart > TOO_FAR * allowed and rest < STEADY * apart:
            text = f"turns {ratio:.3g} times as far as {link}, which a spring of {stiffness:g} N m/rad does not allow"
            yield Remark(
                motor, f"{text}: a gear ratio of {ratio * n:.3g} in place of {n:g}, or a far softer spring", True
            )

    def _units(self, by_motor: bool, turns: float, near: str) -> Iterator[str]:
        """What makes one reading larger by a factor than the other, whose name is `near`."""
        if 1.0 / CLOSE < np.deg2rad(turns) < CLOSE:
            yield f"in degrees, or {near} is in radians where degrees are described"
        gear = self._joint.gear_ratio
        if by_motor and gear != 1.0 and 1.0 / CLOSE < turns / gear < CLOSE:
            yield "the motor's angle before the gear"


def encoder_pairs(system: System, channels: Sequence[str]) -> list[EncoderPair]:
    """Of the joints that have both encoders among some channels."""
    return [
        EncoderPair(
            (motor, channels.index(motor)),
            (link, channels.index(link)),
            channels.index(f"tau_{i}") if f"tau_{i}" in channels else None,
            joint,
        )
        for i, joint in enumerate(system.joints, start=1)
        if {motor := f"theta_m_{i}", link := f"q_{i}"} <= set(channels)
    ]


def other_gears(system: System) -> Iterator[Remark]:
    """What a log's description divides by another gear than that of the joint."""
    for source in system.sources:
        for signal in source.signals.values() if isinstance(source, LogSource) else ():
            found = re.fullmatch(r"(?:theta_m|tau)_(\d+)", signal.channel)
            ratio = 1.0 if found is None else system.joints[int(found[1]) - 1].gear_ratio
            if found is not None and signal.gear not in (1.0, ratio):
                text = f"divided by a gear of {signal.gear:g}, where joint_{found[1]} has a gear ratio of {ratio:g}"
                yield Remark(signal.channel, text, True)
