"""Two encoders of one flexible joint, on either side of its spring: do they turn alike?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sms_adapters.channel_check import Remark
from sms_online.description.schema import System
from sms_online.stream import Array

# From this correlation on two readings are of one motion: a spring that is as soft as its link is heavy leaves less.
SAME_MOTION = 0.95
# Both sides of a spring turn as far up to this factor; further apart they are in other units.
ALIKE = 2.0
# Ratios within this factor of a unit's or the gear's are explained by it: a spring changes them by less.
CLOSE = 1.5
# Samples of both before anything is said.
LEAST_SAMPLES = 100


class EncoderPair:
    """Sums over the samples that hold both readings of a joint, motor side and link side.

    motor, link: names of the channels, and numbers of their columns. gear_ratio: of the joint.
    """

    def __init__(self, motor: tuple[str, int], link: tuple[str, int], gear_ratio: float) -> None:
        self._names, self._columns = (motor[0], link[0]), [motor[1], link[1]]
        self._gear_ratio = gear_ratio
        self._origin: Array | None = None
        self._count, self._sum, self._products = 0, np.zeros(2), np.zeros((2, 2))

    def push(self, values: Array) -> None:
        """Take samples of all channels (B, C)."""
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
            return
        far, near = (motor, link) if abs(ratio) >= 1.0 else (link, motor)
        turns = max(abs(ratio), 1.0 / abs(ratio))
        how = f"{turns:.2g} times as far as {near}" if turns > ALIKE else f"as far as {near}"
        seems = []
        if turns > ALIKE:
            units = " or ".join(self._units(far == motor, turns))
            seems.append(f"it is {units}" if units else "one of them is in another unit")
        if ratio < 0.0:
            how += ", the other way round"
            seems.append("one of them has the wrong sign")
        yield Remark(far, f"turns {how}: {', and '.join(seems)}", True)

    def _units(self, by_motor: bool, turns: float) -> Iterator[str]:
        """What makes one reading larger by a factor than the other."""
        if 1.0 / CLOSE < np.deg2rad(turns) < CLOSE:
            yield "in degrees"
        if by_motor and self._gear_ratio != 1.0 and 1.0 / CLOSE < turns / self._gear_ratio < CLOSE:
            yield "the motor's angle before the gear"


def encoder_pairs(system: System, channels: Sequence[str]) -> list[EncoderPair]:
    """Of the joints that have both encoders among some channels."""
    return [
        EncoderPair((motor, channels.index(motor)), (link, channels.index(link)), joint.gear_ratio)
        for i, joint in enumerate(system.joints, start=1)
        if {motor := f"theta_m_{i}", link := f"q_{i}"} <= set(channels)
    ]
