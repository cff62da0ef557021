"""Residual of each joint relative to its measured torque or force, in the short windows that sessions are judged by."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from sms_online.calibration.channels import Motion
from sms_online.calibration.joints import JointCalibration
from sms_online.calibration.nuisance import Nuisance
from sms_online.description.schema import Effect
from sms_online.diagnosis.candidates import CandidateColumns
from sms_online.diagnosis.rows import SessionRows, joint_windows
from sms_online.diagnosis.weak_windows import SeenMotion, WeakWindows
from sms_online.row_types import joint_rows
from sms_online.stream import Array, Mask


class RelativeResiduals:
    """Rows of the joints over the session, of a model and of effects beside it.

    times (W,): the windows' middles, s since grid index 0. segment (W,): numbers of the segments that hold them.
    measured (W, joints): torques or forces. columns (W, joints, n + c): of the parameters and the effects declared.
    """

    def __init__(self, rows: SessionRows, make: CandidateColumns, gapless: bool = False) -> None:
        """gapless: windows that overlap by half, in place of those that a session is judged by."""
        layout = rows.model.layout
        self._joints = list(layout.theta_m)
        weak = joint_windows(rows, gapless)
        # The relative residual of a session (`JointBalance`), too, foretells friction at a standstill by its law.
        self._make = make.within(weak, resting=True)
        starts, segments = weak.windows.start, weak.windows.segment
        firsts = np.array([segment.index[0] for segment in rows.segments])
        middles = firsts[segments] + starts + weak.windows.width / 2
        self.times = np.asarray(middles / rows.model.system.sample_rate, dtype=np.float64)
        self.segment = segments

        needed = rows.model.of_parameters(rows.base.needed)

        def model(motion: SeenMotion) -> tuple[Array, Array]:
            inputs = self._make.inputs(motion)
            return needed.momentum_columns(motion.x, motion.v, layout.theta_m, inputs)

        physical = weak.columns(model)
        self._Y = rows.base.columns(physical)
        joints = len(layout.q)
        torque = -weak.columns(lambda motion: (None, motion.torque[:, :joints, None]))[..., 0]
        self.measured = torque
        self._b = torque - rows.base.known_part(physical)
        self.columns = self._Y
        names = [p.name for p in rows.base.parameters]
        springs = [f"joint_{i}.stiffness" for i in range(1, len(self._joints) + 1)]
        self._springs = [names.index(spring) if spring in names else None for spring in springs]
        self._deflections, self._torques = self._calibration(rows, weak)

    def _calibration(self, rows: SessionRows, weak: WeakWindows) -> tuple[Array, Array]:
        """What joints' deflections and torques are read too much for one unit of each nuisance, (W, joints, m) both."""
        sensing, layout, calibration = rows.sensing, rows.model.layout, JointCalibration(rows.sensing)
        number = {nuisance: k for k, nuisance in enumerate(rows.calibrated.nuisances)}

        def read(motion: SeenMotion) -> Array:
            values = rows.segments[motion.segment].values[:, sensing.position_columns]
            rates = np.gradient(values, axis=0) * rows.model.system.sample_rate
            turned = np.broadcast_to(np.eye(3), (len(motion.x), 3, 3))
            torque = motion.torque[:, : len(layout.q)]  # without the wrenches behind them
            given = Motion(values[motion.samples], rates[motion.samples], torque, turned)
            return np.concatenate((calibration.deflections(given), calibration.torque(given)), axis=2)

        def spread(each: Array, nuisances: Sequence[Nuisance]) -> Array:
            out = np.zeros((*each.shape[:2], rows.calibrated.count))
            for column, nuisance in zip(np.moveaxis(each, 2, 0), nuisances, strict=True):
                if nuisance in number:
                    out[..., number[nuisance]] = column
            return out

        added = weak.columns(lambda motion: (None, read(motion)))
        deflections, torques = np.split(added, [len(calibration.of_positions)], axis=2)
        return -spread(deflections, calibration.of_positions), -spread(torques, calibration.of_torques)

    def declare(self, effects: Sequence[Effect]) -> None:
        """Effects whose coefficients a solution holds after the model's parameters, in this order."""
        added = [self._make.of(effect).columns[:, self._joints] for effect in effects]
        self.columns = np.concatenate([self._Y, *added], axis=2)

    def of(self, solution: Array, held: Iterable[tuple[Mask, Array]] = ()) -> dict[str, float]:
        """By joint, for a solution (n + c + m,); held: windows (W,) that another solution predicts.

        Calibration is that of deflections and torques.
        """
        rest = self.left(solution)
        for windows, other in held:
            rest[windows] = self.left(other)[windows]
        size = np.linalg.norm(self.measured, axis=0)
        ratio = np.divide(np.linalg.norm(rest, axis=0), size, out=np.zeros_like(size), where=size > 0.0)
        return {joint_rows(i): float(r) for i, r in enumerate(ratio)}

    def left(self, solution: Array) -> Array:
        """What a solution (n + c + m,) leaves of the torques in the rows, (W, joints)."""
        c = self.columns.shape[2]
        stiffness = [0.0 if k is None else solution[k] for k in self._springs]
        calibrated = stiffness * (self._deflections @ solution[c:]) - self._torques @ solution[c:]
        return np.asarray(self._b - self.columns @ solution[:c] + calibrated)
