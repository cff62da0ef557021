"""What an estimator knows at an instant, as one record: whatever is said of a session is a function of it.

It can be pickled, and says the same in another process. A session cannot be continued from it, but from a checkpoint.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sms_online.calibration.nuisance import Nuisance
from sms_online.description.schema import System, TrackerChoice
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.energy_balance import SharedErrors
from sms_online.pipeline.errors_in_variables import NoiseBias, unbiased
from sms_online.pipeline.events import ClockShift, Event
from sms_online.pipeline.joint_balance import SquaredResidual
from sms_online.pipeline.latency import Latency
from sms_online.pipeline.marker_identity import Swap
from sms_online.pipeline.outliers import LeftOut
from sms_online.pipeline.plain_rows import PlainRows
from sms_online.pipeline.scale_free import ScaleFree
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.synchronise import SyncCounters
from sms_online.pipeline.tracker_bank import Reading, Suspected
from sms_online.stream import Array
from sms_online.threads import one_blas_thread
from sms_online.trackers.interface import Estimate, Prior, Tracker

if TYPE_CHECKING:
    from sms_online.smoother.statistics import SmootherStatistics

# What the estimate comes from.
Method = Literal["smoother", "momentum", "energy"]


@dataclass(frozen=True)
class Setup:
    """What is estimated, from one event of a session to the next.

    system: as described. model, base: with what events have added; described: base parameters of the system itself.
    unused: channels of the source that play no part. prior: on `described`; current_prior: on `base`, of which nothing
    is known beforehand where something has changed. nuisances: what the description may be wrong in; smoothed: what the
    smoother's readings may. trackers: of the session, the judged one first. Pickled once, and one object wherever the
    same is read again.
    """

    system: System
    model: Model
    base: BaseParameters
    described: BaseParameters
    sensing: Sensing
    unused: tuple[str, ...]
    prior: Prior | None
    current_prior: Prior | None
    nuisances: tuple[Nuisance, ...]
    smoothed: tuple[Nuisance, ...]
    trackers: tuple[TrackerChoice, ...]

    def __reduce__(self) -> tuple[Any, ...]:
        packed = vars(self).get("_packed")
        if packed is None:
            packed = pickle.dumps(vars(self), protocol=5)
            object.__setattr__(self, "_packed", packed)
        return _setup, (packed,)


@lru_cache(maxsize=2)
def _setup(packed: bytes) -> Setup:
    setup = object.__new__(Setup)
    vars(setup).update(pickle.loads(packed))
    return setup


@dataclass(frozen=True)
class MomentumStatistics:
    """Statistics of the momentum balance.

    reference: nuisances and parameters of the rows without what the judged tracker knows of a drift, None where
    nothing has moved. tracker: its rows so far; bias: what noise in its columns does. rows: unwhitened rows and their
    misfit. started: weights are known. tested: there are rows enough for a test of what they leave. alarm: type of the
    rows that the sequential test finds more than noise in. passing: of types of joints' rows whose residual does not
    last, the torque's channel and the 1σ of its samples that is used. short: too few windows show that. scale_free:
    what gives the estimate where rows leave more than noise. latency: source that is late against the others, if one
    is. coloured, jitters (1σ by device): see `SensorNoise`. suspected: a change of parameters that the judged tracker
    does not follow; unwatched: none is looked for. shifts: of the devices' clocks. point (m,): nuisances that samples
    are corrected by.
    """

    reference: Array | None
    tracker: Tracker
    bias: NoiseBias
    rows: PlainRows
    started: bool
    tested: bool
    alarm: str | None
    passing: dict[str, tuple[str, float]]
    short: bool
    scale_free: ScaleFree | None
    latency: Latency | None
    coloured: dict[str, float]
    jitters: dict[str, float]
    suspected: Suspected | None
    shifts: tuple[ClockShift, ...]
    unwatched: bool
    point: Array


@dataclass(frozen=True)
class Statistics:
    """Sufficient statistics, counts and events of a session up to now.

    finished: no more samples come. outliers: by channel, samples that were left out. last_time (channels,): of each
    one's last sample, s, -inf where none has come. readings: what each chosen tracker says, the judged one first; empty
    where that is the session's own least squares alone. periods (channels,): s a sample, NaN where unknown. energy: the
    energy balance's tracker; shared: what errors that its rows share do. joints: sums behind the relative residual of
    each.
    """

    setup: Setup
    method: Method
    finished: bool
    samples: int
    duration: float
    dropped_rows: int
    counters: SyncCounters
    outliers: dict[str, LeftOut]
    swaps: tuple[Swap, ...]
    last_time: Array
    periods: Array
    events: tuple[Event, ...]
    readings: tuple[Reading, ...]
    energy: Tracker
    shared: SharedErrors
    joints: tuple[SquaredResidual, ...]
    momentum: MomentumStatistics | None
    smoother: SmootherStatistics | None

    @one_blas_thread()
    def estimate(self) -> Estimate:
        """The base parameters, the same bits as from the estimator itself; takes milliseconds."""
        setup = self.setup
        if self.readings:
            return self.readings[0].estimate
        if self.method == "smoother":
            assert self.smoother is not None
            return self.smoother.estimate(setup.prior)
        if self.method == "energy":
            return self.energy_estimate()
        assert self.momentum is not None
        rows, scale_free = self.momentum.tracker.estimate(), self.momentum.scale_free
        joint = unbiased(rows, self.momentum.bias, setup.nuisances) if scale_free is None else scale_free.estimate(rows)
        return joint.without_nuisances(len(setup.nuisances))

    def shift(self, estimate: Estimate) -> Array:
        """By how much noise in the columns biases the momentum balance's estimate (n,), as far as that is known."""
        m = len(self.setup.nuisances)
        determined = np.concatenate((np.isfinite(estimate.nuisances_std), estimate.determined))
        assert self.momentum is not None
        return self.momentum.bias.correction(determined).columns[m:]

    @one_blas_thread()
    def energy_estimate(self) -> Estimate:
        """The estimate of the energy balance alone."""
        return self.energy.estimate()
