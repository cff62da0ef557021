"""Zeros of torques that differ from capture to capture: a current sensor reads another one after each start.

Parameters are common to all captures, a zero is not. A difference is what the model and losses of any kind at the
joints, fitted to all captures, leave of a torque in the mean over one of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.description.channels import channel_unit, drive_channel
from sms_online.description.schema import Effect
from sms_online.diagnosis.attempt import Attempt
from sms_online.diagnosis.constants import is_constant
from sms_online.diagnosis.evidence import RANK_TOLERANCE
from sms_online.diagnosis.relative import RelativeResiduals
from sms_online.stream import Array, Block, Indices

# A zero is taken off where it is this share of the rms of its torque, and this many of its deviations.
LEAST_SHARE, LEAST_DEVIATIONS = 0.01, 4.0
# Rows for each effect, to try all its shapes.
ROWS_EACH = 10
# Stretches whose sums give the deviation of a mean: what is left is correlated.
STRETCHES = 20
# Number of the capture that is held out.
HELD_OUT = -1


@dataclass(frozen=True)
class TorqueZero:
    """What a joint's torque or force reads more in a capture than in the first.

    channel: of the drive. capture: its number, that of the one held out is HELD_OUT. offset, std: at the motor's shaft,
    in `unit`. gravity: whether another load of the arm would show as such a zero.
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
        load = "; where its zero is the same, the arm carries another load" if self.gravity else ""
        return f"{self.channel} reads {size} in {where} than in the first, which was taken off{load}"


def torque_zeros(attempt: Attempt) -> list[TorqueZero]:
    """Zeros of captures after the first, and of the one held out, that differ from those of the first."""
    losses = [
        each.effect
        for each in attempt.tracing.candidates
        if each.effect.where.startswith("joint_")
        and not (each.traits.signed or each.traits.learned or is_constant(each.effect))
    ]
    joints, system, n = RelativeResiduals(attempt.rows, attempt.make, gapless=True), attempt.system, attempt.rows.base.n
    joints.declare(_few(losses, joints.measured.size))
    described = attempt.solution([])
    solution = np.concatenate((described[:n], np.zeros(joints.columns.shape[2] - n), described[n:]))
    fit = _Fit(joints, solution, np.searchsorted(attempt.case.begins, joints.times))
    others = [(k, *fit.against_first(k)) for k in fit.captures[1:]]
    if attempt.case.held:
        elsewhere = attempt.joints_elsewhere()
        elsewhere.declare(_few(losses, joints.measured.size))
        others.append((HELD_OUT, *fit.elsewhere(elsewhere)))
    out = []
    for capture, offset, std, size in others:
        for i in np.flatnonzero(np.abs(offset) > np.maximum(LEAST_SHARE * size, LEAST_DEVIATIONS * std)):
            channel = drive_channel(system, int(i) + 1)
            unit, gravity = channel_unit(system, channel), any(system.gravity)
            out.append(TorqueZero(channel, capture, float(offset[i]), float(std[i]), unit, gravity))
    return out


def _few(effects: Sequence[Effect], rows: int) -> list[Effect]:
    """Effects, each with one shape alone where so many rows determine no more."""
    if rows >= ROWS_EACH * len(effects):
        return list(effects)
    return list({each.key: each for each in reversed(effects)}.values())


class _Fit:
    """Model and effects declared, fitted to the torques of all captures, each with a zero of its own.

    solution (n + c + m,): to begin with. capture (W,): number of each window's. Joints count relative to their own
    torques.
    """

    def __init__(self, joints: RelativeResiduals, solution: Array, capture: Indices) -> None:
        self._joints, self._solution, self._capture = joints, solution.copy(), capture
        columns, left = joints.columns, joints.left(solution)
        size = np.linalg.norm(joints.measured, axis=0)
        self._weight = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
        A = columns * self._weight[:, None]
        raw = np.linalg.norm(A, axis=(0, 1))
        # Those too short for a window have none.
        self._captures = {k: capture == k for k in np.unique(capture).tolist()}
        for own in self._captures.values():
            A[own] -= A[own].mean(axis=0)
        norm = np.linalg.norm(A, axis=(0, 1))
        # Of a column that is a zero itself only rounding is left.
        self._varies = np.flatnonzero(norm > RANK_TOLERANCE * raw)
        scaled = A[..., self._varies].reshape(-1, self._varies.size) / norm[self._varies]
        # Change of the solution by the rows' errors, (c, W, joints).
        change = np.linalg.pinv(scaled, rcond=RANK_TOLERANCE) / norm[self._varies, None]
        self._change = change.reshape(-1, *left.shape) * self._weight
        self._solution[self._varies] += np.tensordot(self._change, left, 2)
        rest = joints.left(self._solution)
        self._zero = {k: rest[own].mean(axis=0) for k, own in self._captures.items()}
        for k, own in self._captures.items():
            rest[own] -= self._zero[k]
        spare = max(1, left.size - self._varies.size - len(self._zero) * size.size)
        self._rest = rest * np.sqrt(left.size / spare)

    @property
    def captures(self) -> list[int]:
        """Numbers of those that were fitted."""
        return list(self._captures)

    def against_first(self, k: int) -> tuple[Array, Array, Array]:
        """What torques at the shaft read more in a capture than in the first, its deviation, and the torque's rms."""
        own = self._captures[k]
        mean = self._joints.columns[own].mean(axis=0)
        errors = np.where(own[:, None], self._rest / own.sum(), 0.0)
        variance = self._variance(mean, errors)
        return self._at_shaft(self._zero[k], variance, self._joints.measured[own])

    def elsewhere(self, joints: RelativeResiduals) -> tuple[Array, Array, Array]:
        """The same of a capture that was not fitted."""
        rest = joints.left(self._solution)
        zero = rest.mean(axis=0)
        variance = self._variance(joints.columns.mean(axis=0), np.zeros_like(self._rest))
        variance += _of_sum((rest - zero) / len(rest))
        return self._at_shaft(zero, variance, joints.measured)

    def _variance(self, mean: Array, errors: Array) -> Array:
        """Variance (joints,) of a zero against the first's.

        mean (joints, n + c): of the columns in its capture. errors (W, joints): its own.
        """
        first = self._captures[self.captures[0]]
        errors = errors - np.where(first[:, None], self._rest / first.sum(), 0.0)
        difference = (mean - self._joints.columns[first].mean(axis=0))[:, self._varies]
        # Rows of all joints change the solution, and with it the mean of each.
        by_rows = np.einsum("cwj,wj->wc", self._change, self._rest)
        return _of_sum(errors - by_rows @ difference.T)

    def _at_shaft(self, zero: Array, variance: Array, measured: Array) -> tuple[Array, Array, Array]:
        unit = self._joints.unit
        size = np.sqrt(np.mean(measured**2, axis=0)) / unit
        return (zero - self._zero[self.captures[0]]) / unit, np.sqrt(variance) / unit, size


def _of_sum(errors: Array) -> Array:
    """Variance (joints,) of the sum of errors (W, joints) that are correlated over a while."""
    sums = [part.sum(axis=0) for part in np.array_split(errors, min(STRETCHES, len(errors)))]
    return np.asarray(np.sum(np.square(sums), axis=0))


def without_zeros(blocks: Sequence[Block], zeros: Sequence[TorqueZero], capture: int) -> list[Block]:
    """Blocks of a capture without what its torques read more than those of the first."""
    offsets = {each.channel: each.offset for each in zeros if each.capture == capture}
    return [
        Block(block.t, block.channels, block.values - [offsets.get(name, 0.0) for name in block.channels])
        for block in blocks
    ]
