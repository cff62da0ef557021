"""Residual of each joint relative to its measured torque or force, in the short windows that sessions are judged by."""

from __future__ import annotations

from collections.abc import Sequence

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

    A window belongs to the part of the session that its middle lies in: `times` (W,), s since grid index 0, and the
    segment's number, `segment` (W,).
    """

    def __init__(self, rows: SessionRows, make: CandidateColumns) -> None:
        layout = rows.model.layout
        self._joints = list(layout.theta_m)
        self._windows = weak = joint_windows(rows)
        # The relative residual of a session (`JointBalance`), too, foretells friction at a standstill by its law.
        self._make = make.within(weak, resting=True)
        starts, segments = weak.windows.start, weak.windows.segment
        firsts = np.array([segment.index[0] for segment in rows.segments])
        self.times = (firsts[segments] + starts + weak.windows.width / 2) / rows.model.system.sample_rate
        self.segment = segments

        def model(motion: Motion) -> tuple[Array, Array]:
            inputs = self._make.inputs(motion)
            return rows.model.momentum_columns(motion.x, motion.v, layout.theta_m, inputs)

        physical = weak.columns(model)
        self._Y = rows.base.columns(physical)
        torque = -weak.columns(lambda motion: (None, motion.torque[:, :, None]))[..., 0]
        self._measured = torque
        self._b = torque - rows.base.known_part(physical)
        self._effects: list[Array] = []

    def declare(self, effects: Sequence[Effect]) -> None:
        """Effects whose coefficients a solution holds after the model's parameters, in this order."""
        self._effects = [self._make.of(effect).columns[:, self._joints] for effect in effects]

    def of(self, solution: Array, windows: NDArray[np.bool_]) -> dict[str, float]:
        """By joint, over some of the windows (W,), for parameters and coefficients (n + c,)."""
        columns = np.concatenate([self._Y, *self._effects], axis=2)[windows]
        left = self._b[windows] - columns @ solution
        size = np.linalg.norm(self._measured[windows], axis=0)
        ratio = np.divide(np.linalg.norm(left, axis=0), size, out=np.zeros_like(size), where=size > 0.0)
        return {joint_rows(i): float(r) for i, r in enumerate(ratio)}
