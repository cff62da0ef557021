"""The Kalman tracker of a session: least squares until all is determined, then filterpy's filter."""

from __future__ import annotations

from sms_online.state import State
from sms_online.stream import Array
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Estimate, Prior, Rows, Tracker
from sms_online.trackers.kalman import KalmanTracker
from sms_online.trackers.square_root import RecursiveLeastSquares

# Initial deviation, in those of the least squares that it starts from: no more than 1e-6 of their information, and the
# deviation beyond which no parameter walks.
INITIAL = 1000.0


class WalkState(State):
    """taken: rows before the filter starts. value, std (n,): where it starts, None before."""

    taken: int = 0
    value: Array | None = None
    std: Array | None = None


class RandomWalk(Tracker):
    """Random walk of π, process_std (n,) in units per √s, with a prior on some of it; see `KalmanTracker`.

    rows_a_look: from one look whether the rows determine all parameters to the next.

    A covariance filter needs a finite initial covariance, which is unknown: until the rows determine all parameters
    this is recursive least squares, in square-root information form, and the filter starts from its result. Where the
    rows never determine a parameter it stays that. With scaled columns the paper's example has a condition number of
    some 1e4, so 1e8 in a covariance, which Joseph's form holds; a trend would add rates of which nothing is known,
    and is in square-root information form therefore, see `drift`.
    """

    def __init__(self, n: int, process_std: Array, prior: Prior, rows_a_look: int) -> None:
        self._n, self._process_std, self._prior, self._rows_a_look = n, process_std, prior, rows_a_look
        self._filter: KalmanTracker | None = None
        self.state = WalkState()
        self.begin(Information.none(n))

    def update(self, rows: Rows) -> None:
        """Take in rows; ValueError where their width is not n."""
        # One by one, for the start must not depend on how rows come.
        for k in range(len(rows.t)):
            row = Rows(rows.Y[k : k + 1], rows.b[k : k + 1], rows.std[k : k + 1], rows.t[k : k + 1])
            if self._filter is not None:
                self._filter.update(row)
                continue
            self._squares.update(row)
            self.state.taken += 1
            if self.state.taken % self._rows_a_look == 0:
                self._start()

    def _start(self) -> None:
        """Go on with the filter, if all is determined."""
        known = self._squares.information
        estimate = self._squares.estimate()
        if not estimate.determined.all() or estimate.dof <= 0.0:
            return
        self.state.value, self.state.std = estimate.pi, INITIAL * estimate.std
        self.renew()
        assert self._filter is not None
        self._filter.begin(known)

    def renew(self) -> None:
        """See Stage."""
        value, std = self.state.value, self.state.std
        known = None if value is None or std is None else Prior(value, std)
        self._filter = None if known is None else KalmanTracker(self._n, self._process_std, known)

    def estimate(self) -> Estimate:
        """The estimate from all rows; leaves the state as it is."""
        return self._squares.estimate() if self._filter is None else self._filter.estimate()

    @property
    def information(self) -> Information:
        """What is known of π now."""
        return self._squares.information if self._filter is None else self._filter.information

    def begin(self, known: Information) -> None:
        """Forget all rows, and go on from given information about π; the prior stays."""
        self._squares = RecursiveLeastSquares(self._n, prior=self._prior)
        self._squares.begin(known)
        self._filter, self.state = None, WalkState()
