"""What a session looked like on the way: estimates, residuals and positions at instants, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from sms_online.evaluation import Evaluation
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.statistics import Statistics
from sms_online.stream import Array, Block
from sms_tools.view.known import Known
from sms_tools.view.readings import SampleAndHold
from sms_tools.view.residuals import RecentResidual

# Instants a second to begin with: estimates change by internal blocks of a quarter second.
RATE = 4.0
# More instants than a chart has room for are thinned to every other one.
MOST_INSTANTS = 400


@dataclass(frozen=True)
class Instant(Known):
    """With what is known, relative residuals (joints,) and positions x (n_x,)."""

    residual: Array
    x: Array


@dataclass(frozen=True)
class Course:
    """N instants t (N,), s, of a session.

    estimate, std (N, n): of what was determined then, else NaN. residual (N, joints): share of the measured torque or
    force over the last second. x (N, n_x): measured positions, NaN before every channel had a reading.
    """

    t: Array
    estimate: Array
    std: Array
    residual: Array
    x: Array


class History:
    """Instants of one session, evenly spread over it."""

    def __init__(self, estimator: Estimator, channels: tuple[str, ...]) -> None:
        self.instants: list[Instant] = []
        self._estimator = estimator
        self._held = SampleAndHold(estimator.sensing.channels, channels)
        self._interval = 1.0 / RATE
        self._due = -np.inf
        self._t = np.nan
        self._recent = RecentResidual()

    def watch(self, blocks: Iterable[Block]) -> Iterator[Block]:
        """The same samples, in pieces no longer than the interval; each is recorded once it has been used."""
        longest = max(1, round(self._estimator.system.sample_rate / RATE))
        for block in blocks:
            for piece in block.pieces(longest):
                yield piece
                self._look(piece)

    def finish(self) -> None:
        """The session's end, after the estimator has finished: its last instant is what the results say."""
        if self.instants and self.instants[-1].t == self._t:
            self.instants.pop()
        if np.isfinite(self._t):
            self._add()

    @property
    def course(self) -> Course:
        """What was seen, as arrays."""
        estimator, instants = self._estimator, self.instants
        estimate, std = np.full((2, len(instants), estimator.base.n), np.nan)
        for k, instant in enumerate(instants):
            # Fewer before an event has added some.
            known = np.flatnonzero(instant.determined)
            estimate[k, known], std[k, known] = instant.estimate[known], instant.std[known]
        joints, n_x = len(estimator.system.joints), estimator.model.layout.n_x
        return Course(
            t=np.array([instant.t for instant in instants]),
            estimate=estimate,
            std=std,
            residual=np.array([instant.residual for instant in instants]).reshape(-1, joints),
            x=np.array([instant.x for instant in instants]).reshape(-1, n_x),
        )

    def _look(self, block: Block) -> None:
        self._held.push(block)
        self._t = float(block.t[-1])
        if self._t < self._due:
            return
        self._due = self._t + self._interval
        self._add()
        if len(self.instants) >= MOST_INSTANTS:
            self.instants = self.instants[::2]
            self._interval *= 2.0

    def _add(self) -> None:
        estimator = self._estimator
        now = Evaluation(Statistics.of(estimator), estimator.estimate())
        estimate = now.estimate.pi
        residual = self._recent.push(self._t, now.statistics, estimate)
        x = np.full(estimator.model.layout.n_x, np.nan)
        if np.isfinite(self._held.last).all():
            x = estimator.sensing.coordinates(self._held.last[None])[0]
        self.instants.append(Instant(self._t, estimate, now.std, residual, x))
