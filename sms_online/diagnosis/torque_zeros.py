"""Zeros of torques that differ from capture to capture: a current sensor reads another one after each start.

Parameters are common to all captures, a zero is not. A difference is what the model and losses of any kind at the
joints, fitted to all captures, leave of a torque in the mean over one of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student_t

from sms_online.description.channels import channel_unit
from sms_online.description.schema import Effect
from sms_online.diagnosis.attempt import Attempt
from sms_online.diagnosis.constants import is_constant
from sms_online.diagnosis.evidence import solution_of
from sms_online.diagnosis.relative import RelativeResiduals
from sms_online.pipeline.joint_balance import JointBalance
from sms_online.stream import Array, Block, Indices

# A zero is taken off where it is this share of the rms of its torque, and no chance but with this probability.
LEAST_SHARE, FALSE_ALARM = 0.01, 1e-3
# Rows for each effect, to try all its shapes.
ROWS_EACH = 10
# What is left is correlated over a while, so that stretches of a capture are left out at once, of so many windows.
LEAST_WINDOWS = 10
# Of a capture, at least and at most.
LEAST_STRETCHES, MOST_STRETCHES = 5, 20
# Number of the capture that is held out.
HELD_OUT = -1


@dataclass(frozen=True)
class TorqueZero:
    """What a joint's torque or force reads more in a capture than in the first.

    channel: of the drive. capture: its number, that of the one held out is HELD_OUT. offset, std: of the channel, in
    `unit`. gravity: whether another load of the arm would show as such a zero.
    """

    channel: str
    capture: int
    offset: float
    std: float
    unit: str
    gravity: bool = False

    @property
    def sentence(self) -> str:
        """In words, with captures counted from 1."""
        where = "the capture held out" if self.capture == HELD_OUT else f"capture {self.capture + 1}"
        size = f"{abs(self.offset):.2g} ± {self.std:.1g} {self.unit} {'more' if self.offset > 0.0 else 'less'}"
        load = ", or the arm carries another load there" if self.gravity else ""
        return f"{self.channel} reads {size} in {where} than in the first{load}; it was taken off"


def torque_zeros(attempt: Attempt) -> list[TorqueZero]:
    """Zeros of captures after the first, and of the one held out, that differ from those of the first.

    None where the first is too short to be compared with.
    """
    losses = [
        each.effect
        for each in attempt.tracing.candidates
        if each.effect.where.startswith("joint_")
        and not (each.traits.signed or each.traits.learned or is_constant(each.effect))
    ]
    joints, elsewhere = RelativeResiduals(attempt.rows, attempt.make, gapless=True), attempt.joints_elsewhere()
    tried = _few(losses, joints.measured.size)
    joints.declare(tried)
    if elsewhere is not None:
        elsewhere.declare(tried)
    n, described = attempt.rows.base.n, attempt.solution([])
    described = np.concatenate((described[:n], np.zeros(joints.columns.shape[2] - n), described[n:]))
    offsets = _Offsets(joints, elsewhere, described, np.searchsorted(attempt.case.begins, joints.times))
    sensing, system, out = attempt.rows.sensing, attempt.system, []
    weight = JointBalance(attempt.rows.model, attempt.rows.base, system.sample_rate).weight
    for capture in offsets.comparable:
        offset, std, size = offsets.against_first(capture)
        # Few stretches give a deviation that is uncertain itself.
        most = float(student_t.isf(0.5 * FALSE_ALARM, offsets.freedom(capture)))
        for i, (channel, ratio) in sensing.drives.items():
            if abs(offset[i]) > max(LEAST_SHARE * size[i], most * std[i]) and size[i] > 0.0:
                value, deviation = (float(each[i]) / (weight * ratio) for each in (offset, std))
                unit = channel_unit(system, channel)
                out.append(TorqueZero(channel, capture, value, deviation, unit, any(system.gravity)))
    return out


def _few(effects: Sequence[Effect], rows: int) -> list[Effect]:
    """Effects, each with one shape alone where so many rows determine no more."""
    if rows >= ROWS_EACH * len(effects):
        return list(effects)
    return list({each.key: each for each in reversed(effects)}.values())


class _Offsets:
    """What model and effects declared leave of the torques in the mean over each capture, and its deviation.

    They are fitted to all captures but the one held out, `elsewhere`, each with an offset of its own. described (n + c
    + m,): a solution to begin with. capture (W,): number of each window's. Joints count relative to their own torques.
    Deviations are those of the jackknife: one stretch after the other is left out of the fit.
    """

    def __init__(
        self, joints: RelativeResiduals, elsewhere: RelativeResiduals | None, described: Array, capture: Indices
    ) -> None:
        size = np.linalg.norm(joints.measured, axis=0)
        weight = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
        columns, left = joints.columns, joints.left(described)
        self._parts = {}
        for k in np.unique(capture).tolist():
            own = capture == k
            self._parts[k] = _Part(columns[own], left[own], joints.measured[own], weight)
        self._fitted = list(self._parts)
        if elsewhere is not None:
            self._parts[HELD_OUT] = _Part(elsewhere.columns, elsewhere.left(described), elsewhere.measured, weight)
        self._offset = self._means()
        self._without = {
            k: [self._means(k, number) for number in range(len(part.stretches))] for k, part in self._parts.items()
        }

    @property
    def comparable(self) -> list[int]:
        """Captures that are long enough, none where the first is not."""
        long = [k for k, part in self._parts.items() if len(part.stretches) >= LEAST_STRETCHES]
        return [k for k in long if k != 0] if 0 in long else []

    def freedom(self, capture: int) -> int:
        """Degrees of freedom of the deviation of a capture's offset, at least."""
        return min(len(self._parts[k].stretches) for k in (0, capture)) - 1

    def against_first(self, capture: int) -> tuple[Array, Array, Array]:
        """An offset in the rows against that of the first, its deviation, and the torque's rms, (joints,) each."""
        variance = np.zeros_like(self._offset[capture])
        for without in self._without.values():
            if len(without) > 1:
                each = np.array([means[capture] - means[0] for means in without])
                variance += (len(each) - 1) ** 2 / len(each) * each.var(axis=0, ddof=1)
        return self._offset[capture] - self._offset[0], np.sqrt(variance), self._parts[capture].size

    def _means(self, capture: int | None = None, stretch: int | None = None) -> dict[int, Array]:
        """What is left in the mean over each capture (joints,), without a stretch of one."""
        kept = {k: part.without(stretch if k == capture else None) for k, part in self._parts.items()}
        gram = np.sum([kept[k].centred for k in self._fitted], axis=0)
        raw = np.sum([np.diag(kept[k].gram) for k in self._fitted], axis=0)[:-1]
        # A column that is an offset itself leaves nothing.
        change = np.append(solution_of(gram, raw), -1.0)
        return {k: -each.mean @ change for k, each in kept.items()}


@dataclass(frozen=True)
class _Sums:
    """Sums over windows of the rows [columns left] (n + c + 1) of each joint.

    gram: of their products, joints by their weights. total (joints, n + c + 1). weight (joints,). count: of windows.
    """

    gram: Array
    total: Array
    weight: Array
    count: int

    @property
    def mean(self) -> Array:
        """Of the rows of each joint, (joints, n + c + 1)."""
        return self.total / self.count

    @property
    def centred(self) -> Array:
        """The products of rows without their means."""
        weighted = self.mean * self.weight[:, None]
        return np.asarray(self.gram - self.count * weighted.T @ weighted)


class _Part:
    """A capture, in stretches: columns (W, joints, n + c), what a solution leaves of them, torques (W, joints)."""

    def __init__(self, columns: Array, left: Array, measured: Array, weight: Array) -> None:
        rows = np.concatenate((columns, left[..., None]), axis=2)
        self.size = np.sqrt(np.mean(measured**2, axis=0))
        count = max(1, min(MOST_STRETCHES, len(rows) // LEAST_WINDOWS))
        self.stretches = []
        for each in np.array_split(rows, count):
            weighted = (each * weight[:, None]).reshape(-1, rows.shape[2])
            self.stretches.append(_Sums(weighted.T @ weighted, each.sum(axis=0), weight, len(each)))

    def without(self, stretch: int | None) -> _Sums:
        """The sums of all stretches but one."""
        kept = [each for number, each in enumerate(self.stretches) if number != stretch] or self.stretches
        return _Sums(
            np.sum([each.gram for each in kept], axis=0),
            np.sum([each.total for each in kept], axis=0),
            kept[0].weight,
            sum(each.count for each in kept),
        )


def without_zeros(blocks: Sequence[Block], zeros: Sequence[TorqueZero], capture: int) -> list[Block]:
    """Blocks of a capture without what its torques read more than those of the first."""
    offsets = {each.channel: each.offset for each in zeros if each.capture == capture}
    return [
        Block(block.t, block.channels, block.values - [offsets.get(name, 0.0) for name in block.channels])
        for block in blocks
    ]
