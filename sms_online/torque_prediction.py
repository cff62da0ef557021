"""The torques that fixed parameters predict over a session, and the least that any parameters would leave of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.description.channels import channel_unit
from sms_online.description.tree import index_of
from sms_online.diagnosis.evidence import solution_of
from sms_online.diagnosis.residuals import rms
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.joint_balance import JointBalance
from sms_online.pipeline.observer import Observer
from sms_online.row_types import joint_rows
from sms_online.stream import Array, Indices

# A joint with dry friction is at rest where it is slower than this share of its fastest so far: friction takes any
# value up to breakaway there, which no parameters predict.
AT_REST = 0.01


@dataclass(frozen=True)
class TorqueCourse:
    """A joint's torque or force over short windows, as its channel reads it.

    t (W,): middle of each window, s. measured (W,), predicted (W,): mean over it, weighted by its test function, in
    `unit`. soft: by how much a deflection of its spring would have to be read too large, rad (m), for one `unit` of
    torque; 0 where the joint has none. at_rest: share of the run's windows that are left out, see `AT_REST`.
    """

    channel: str
    unit: str
    t: Array
    measured: Array
    predicted: Array
    soft: float = 0.0
    at_rest: float = 0.0

    @property
    def left(self) -> float:
        """rms of the prediction error over rms of the torque."""
        return rms(self.predicted - self.measured) / rms(self.measured)

    @property
    def zero(self) -> float:
        """What the channel reads too much throughout, in `unit`, if the prediction is right."""
        return float(np.mean(self.measured - self.predicted))

    @property
    def turned(self) -> float:
        """By how much zeros of the encoders beside its spring would have to be off in place of that, rad (m)."""
        return -self.zero * self.soft

    @property
    def zero_share(self) -> float:
        """Its size over rms of the torque."""
        return abs(self.zero) / rms(self.measured)


class TorquePrediction(Observer):
    """Predicts the torques of a session window by window; put into `Estimator.observers`.

    beta (n,): base parameters. known (m,): the session's nuisances. fixed: numbers of parameters that a fit to the run
    leaves as they are.
    """

    def __init__(self, session: Estimator, beta: Array, known: Array, fixed: Sequence[int]) -> None:
        sensing = None if session.sensing.missing else session.sensing
        self._session, self._rate = session, session.system.sample_rate
        self._balance = JointBalance(session.model, session.base, self._rate, sensing, gapless=True)
        self._unknowns = [each.unknowns(beta, known) for each in self._balance.state.residuals]
        self._free = np.setdiff1d(np.arange(beta.size), fixed)
        stiffness = {p.name: value for p, value in zip(session.base.parameters, beta.tolist(), strict=True)}
        springs = {i: stiffness.get(f"{joint_rows(i)}.stiffness", 0.0) for i in session.sensing.drives}
        self._soft = {i: ratio / springs[i] if springs[i] else 0.0 for i, (_, ratio) in session.sensing.drives.items()}
        # Channel of each drive, and what one unit of it is in the rows.
        self._drives = {
            i: (channel, self._balance.weight * ratio) for i, (channel, ratio) in session.sensing.drives.items()
        }
        layout, effects = session.model.layout, session.model.effects
        dry = {each.axis(layout) for each in effects if each.dry}
        self._rubbing = {i for i in self._drives if layout.theta_m[i] in dry}
        self._fastest = np.zeros(len(layout.theta_m))
        self._at_rest = dict.fromkeys(self._drives, 0)
        self._segment = -1
        self._windows: dict[int, list[tuple[float, float, float]]] = {i: [] for i in self._drives}
        # Sums over windows of the products of [Y r 1], joint by joint.
        self._gram = {i: np.zeros((self._free.size + 2, self._free.size + 2)) for i in self._drives}

    def motion(self, index: Indices, segment: int, x: Array, v: Array, inputs: Array, states: Array) -> None:
        """See `Observer`."""
        if segment != self._segment:
            self._segment = segment
            self._balance.begin_segment()
        for start, rows, measured, speed in self._balance.windows(x, v, np.concatenate((inputs, states), axis=1)):
            middle = (index[0] + start + self._balance.width // 2) / self._rate
            self._fastest = np.fmax(self._fastest, speed)
            for i, (_, unit) in self._drives.items():
                if i in self._rubbing and speed[i] < AT_REST * self._fastest[i]:
                    self._at_rest[i] += 1
                elif np.isfinite(rows[i]).all():
                    error = float(rows[i] @ self._unknowns[i])
                    self._windows[i].append((middle, measured[i] / unit, (measured[i] + error) / unit))
                    columns = np.concatenate((rows[i][self._free], [error, 1.0]))
                    self._gram[i] += np.outer(columns, columns)

    @property
    def courses(self) -> dict[str, TorqueCourse]:
        """By `joint_i`; those without a torque are left out."""
        system, start, out = self._session.system, self._session.start_time, {}
        for i, windows in self._windows.items():
            if windows:
                t, measured, predicted = np.array(windows).T
                if measured.any():
                    channel, _ = self._drives[i]
                    unit = channel_unit(system, channel)
                    rest = self._at_rest[i] / (self._at_rest[i] + len(windows))
                    out[joint_rows(i)] = TorqueCourse(
                        channel, unit, start + t, measured, predicted, self._soft[i], rest
                    )
        return out

    def least(self, courses: Mapping[str, TorqueCourse]) -> dict[str, float]:
        """By joint, the share of its torque that parameters leave which fit the whole run best, beside its zero.

        They fit the torques of all joints that have a course, each relative to its own.
        """
        left, raw = {}, np.zeros(self._free.size)
        for name, course in courses.items():
            i = index_of(name)
            signal = float(np.sum((course.measured * self._drives[i][1]) ** 2))
            # What columns have in the mean is what the zero of the torque takes of them.
            gram, sums, count = self._gram[i][:-1, :-1], self._gram[i][-1, :-1], self._gram[i][-1, -1]
            left[name] = (gram - np.outer(sums, sums) / count) / signal
            raw += np.diag(gram)[:-1] / signal
        w = np.append(-solution_of(np.sum(list(left.values()), axis=0), raw), 1.0)
        return {name: float(np.sqrt(max(0.0, w @ gram @ w))) for name, gram in left.items()}
