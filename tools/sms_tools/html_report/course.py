"""What passed in a session, beside its estimates: residuals and positions at instants, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from sms_online.session import Session
from sms_online.stream import Array, Block
from sms_tools.view.readings import SampleAndHold
from sms_tools.view.residuals import RecentResidual

# Instants a second to begin with: estimates change by internal blocks of a quarter second.
RATE = 4.0
# More instants than a chart has room for are thinned to every other one.
MOST_INSTANTS = 400


@dataclass(frozen=True)
class Course:
    """Instants of a session, s.

    residual (N, joints) at tested (N,): share of the measured torque or force over the last second. x (M, n_x) at
    seen (M,): measured positions.
    """

    tested: Array
    residual: Array
    seen: Array
    x: Array


class _Spread:
    """Rows (n,) at instants, evenly spread."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._rows: list[tuple[float, Array]] = []
        self._interval = 1.0 / RATE

    def is_due(self, t: float) -> bool:
        return not self._rows or t >= self._rows[-1][0] + self._interval

    def add(self, t: float, row: Array) -> None:
        self._rows = [*(each for each in self._rows if each[0] < t), (t, row)]
        if len(self._rows) >= MOST_INSTANTS:
            self._rows, self._interval = self._rows[::2], 2.0 * self._interval

    @property
    def arrays(self) -> tuple[Array, Array]:
        """t (N,) and rows (N, n)."""
        return np.array([t for t, _ in self._rows]), np.array([row for _, row in self._rows]).reshape(-1, self._n)


class CourseRecorder:
    """Looks at what passes on its way to a session, and at what the session's recorder evaluates."""

    def __init__(self, session: Session) -> None:
        self._session, estimator = session, session.estimator
        self._held = SampleAndHold(estimator.sensing.channels, session.channels)
        self._recent = RecentResidual()
        self._residual = _Spread(len(estimator.system.joints))
        self._x = _Spread(estimator.model.layout.n_x)

    def watch(self, blocks: Iterable[Block]) -> Iterator[Block]:
        """The same samples, in pieces no longer than the interval; each is recorded once it has been used."""
        longest = max(1, round(self._session.system.sample_rate / RATE))
        for block in blocks:
            for piece in block.pieces(longest):
                yield piece
                self._held.push(piece)
                self._look(float(piece.t[-1]))

    @property
    def course(self) -> Course:
        """What was seen, as arrays; of a finished session up to its end."""
        self._test(always=self._session.estimator.finished)
        return Course(*self._residual.arrays, *self._x.arrays)

    def _look(self, t: float) -> None:
        self._test()
        if self._x.is_due(t) and np.isfinite(self._held.last).all():
            self._x.add(t, self._session.estimator.sensing.coordinates(self._held.last[None])[0])

    def _test(self, always: bool = False) -> None:
        latest = self._session.recorder.latest
        if latest is not None and (always or self._residual.is_due(latest[0])):
            t, now = latest
            self._residual.add(t, self._recent.push(t, now.statistics, now.estimate.pi, now.estimate.nuisances))
