"""What an estimator knows at an instant, taken fast enough for its own thread, and put into a replica of it.

What is large is not copied: the estimator writes such arrays once. A replica answers whatever the estimator itself
would: estimate, error bars, the whole results document. It cannot continue the session; `Estimator.state` is for that,
and holds much more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sms_online.description.schema import Effect
from sms_online.pipeline.estimator import Estimator, SquaredResidual
from sms_online.pipeline.events import Event
from sms_online.pipeline.momentum import Momentum
from sms_online.pipeline.synchronise import SyncCounters
from sms_online.stream import Array
from sms_online.trackers.interface import State


@dataclass(frozen=True)
class MomentumSnapshot:
    """Of the momentum balance: its tracker, the bias of noisy columns, and the sums behind whitened residuals.

    added: names of the parameters that events have added. adopted: effects that were taken up.
    """

    events: tuple[Event, ...]
    added: tuple[str, ...]
    adopted: tuple[Effect, ...]
    windows: int
    dropped_windows: int
    tracker: State
    bias: dict[str, Array]
    weights: Array | None
    misfit: Array
    plain_gram: Array
    plain_windows: int


@dataclass(frozen=True)
class Snapshot:
    """Counts, and the states of what turns rows into numbers."""

    samples: int
    duration: float
    dropped_rows: int
    counters: SyncCounters
    energy_tracker: State
    shared_errors: dict[str, Any]
    joint_residuals: list[SquaredResidual]
    momentum: MomentumSnapshot | None
    smoother: dict[str, Any] | None


def take(estimator: Estimator) -> Snapshot:
    """What the estimator knows now; nothing in it changes when the estimator goes on."""
    return Snapshot(
        samples=estimator.samples,
        duration=estimator.duration,
        dropped_rows=estimator.dropped_rows,
        counters=SyncCounters(**vars(estimator.counters)),
        energy_tracker=estimator.energy_tracker.state(),
        shared_errors=estimator.shared_errors.state(),
        joint_residuals=[SquaredResidual(r.gram, r.signal) for r in estimator.joint_residuals],
        momentum=None if estimator.momentum is None else _take_momentum(estimator.momentum),
        smoother=None if estimator.smoother is None else estimator.smoother.told(),
    )


def _take_momentum(momentum: Momentum) -> MomentumSnapshot:
    fit = momentum.fit
    return MomentumSnapshot(
        events=tuple(momentum.changes.events),
        added=momentum.changes.added,
        adopted=momentum.changes.adopted,
        windows=momentum.windows,
        dropped_windows=momentum.dropped_windows,
        tracker=momentum.tracker.state(),
        bias=momentum.bias.state(),
        weights=fit.weights,
        misfit=fit.misfit,
        plain_gram=fit.plain_gram,
        plain_windows=fit.plain_windows,
    )


def apply(snapshot: Snapshot, replica: Estimator) -> None:
    """Make an estimator of the same system, channels and priors know the same."""
    replica.samples, replica.duration = snapshot.samples, snapshot.duration
    replica.dropped_rows = snapshot.dropped_rows
    vars(replica.counters).update(vars(snapshot.counters))
    replica.energy_tracker.restore(snapshot.energy_tracker)
    replica.shared_errors.restore(snapshot.shared_errors)
    replica.joint_residuals = snapshot.joint_residuals
    if snapshot.smoother is not None and replica.smoother is not None:
        replica.smoother.learn(snapshot.smoother)
    known, momentum = snapshot.momentum, replica.momentum
    if known is not None and momentum is not None:
        momentum.follow(known.events, known.added, known.adopted)
        momentum.windows, momentum.dropped_windows = known.windows, known.dropped_windows
        momentum.tracker.restore(known.tracker)
        momentum.bias.restore(known.bias)
        fit = momentum.fit
        fit.weights, fit.misfit = known.weights, known.misfit
        fit.plain_gram, fit.plain_windows = known.plain_gram, known.plain_windows
