"""Residual of each joint relative to its measured torque or force, in the short windows that sessions are judged by."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from sms_online.description.schema import Effect
from sms_online.diagnosis.candidates import CandidateColumns
from sms_online.diagnosis.rows import SessionRows, joint_windows
from sms_online.diagnosis.weak_windows import Motion
from sms_online.row_types import joint_rows
from sms_online.stream import Array


class RelativeResiduals:
    """Rows of the joints over the session, of a model and of effects beside it.

    times (W,): the windows' middles, s since grid index 0. segment (W,): numbers of the segments that hold them.
    """

    def __init__(self, rows: SessionRows, make: CandidateColumns) -> None:
        layout = rows.model.layout
        self._joints = list(layout.theta_m)
        self._windows = weak = joint_windows(rows)
        # The relative residual of a session (`JointBalance`), too, foretells friction at a standstill by its law.
        self._make = make.within(weak, resting=True)
        starts, segments = weak.windows.start, weak.windows.segment
        firsts = np.array([segment.index[0] for segment in rows.segments])
        middles = firsts[segments] + starts + weak.windows.width / 2
        self.times = np.asarray(middles / rows.model.system.sample_rate, dtype=np.float64)
        self.segment = segments

        def model(motion: Motion) -> tuple[Array, Array]:
            inputs = self._make.inputs(motion)
            return rows.model.momentum_columns(motion.x, motion.v, layout.theta_m, inputs)

        physical = weak.columns(model)
        self._Y = rows.base.columns(physical)
        joints = len(layout.q)
        torque = -weak.columns(lambda motion: (None, motion.torque[:, :joints, None]))[..., 0]
        self._measured = torque
        self._b = torque - rows.base.known_part(physical)
        self._effects: list[Array] = []

    def declare(self, effects: Sequence[Effect]) -> None:
        """Effects whose coefficients a solution holds after the model's parameters, in this order."""
        self._effects = [self._make.of(effect).columns[:, self._joints] for effect in effects]

    def of(self, solution: Array, held: Iterable[tuple[NDArray[np.bool_], Array]] = ()) -> dict[str, float]:
        """By joint, for a solution (n + c + m,); held: windows (W,) that another solution predicts.

        Calibration is left out: within its tolerances it is little beside a torque.
        """
        columns = np.concatenate([self._Y, *self._effects], axis=2)
        c = columns.shape[2]
        left = self._b - columns @ solution[:c]
        for windows, other in held:
            left[windows] = self._b[windows] - columns[windows] @ other[:c]
        size = np.linalg.norm(self._measured, axis=0)
        ratio = np.divide(np.linalg.norm(left, axis=0), size, out=np.zeros_like(size), where=size > 0.0)
        return {joint_rows(i): float(r) for i, r in enumerate(ratio)}
