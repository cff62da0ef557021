"""What an estimator knows at an instant, taken fast enough for its own thread, and put into a replica of it.

What is large is not copied: the estimator writes such arrays once. A replica answers whatever the estimator itself
would: estimate, error bars, the whole results document. It cannot continue the session; `Estimator.state` is for that,
and holds much more.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from sms_online.description.schema import Effect
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.events import Event
from sms_online.pipeline.joint_balance import SquaredResidual
from sms_online.pipeline.momentum import Momentum
from sms_online.pipeline.residual_test import Alarm
from sms_online.stream import Array
from sms_online.trackers.interface import State


class MomentumSnapshot(NamedTuple):
    """Of the momentum balance: its tracker, the bias of noisy columns, and the sums behind whitened residuals.

    added: names of the parameters that events have added. adopted: effects that were taken up. alarm: of the sequential
    test. unexplained: joint that forbids weights. latencies: of the sources.
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
    alarm: Alarm | None
    unexplained: int | None
    latencies: dict[str, Any]


class Snapshot(NamedTuple):
    """Counts, and the states of what turns rows into numbers.

    counters: the synchroniser's, by name. joint_residuals: Gram matrix and signal of each joint's rows.
    """

    samples: int
    duration: float
    dropped_rows: int
    counters: Mapping[str, int]
    energy_tracker: State
    shared_errors: dict[str, Any]
    joint_residuals: tuple[tuple[Array, float], ...]
    momentum: MomentumSnapshot | None
    smoother: dict[str, Any] | None


def take(estimator: Estimator) -> Snapshot:
    """What the estimator knows now; nothing in it changes when the estimator goes on."""
    momentum, smoother = estimator.momentum, estimator.smoother
    return Snapshot(
        estimator.samples,
        estimator.duration,
        estimator.dropped_rows,
        vars(estimator.counters).copy(),
        estimator.energy_tracker.state(),
        estimator.shared_errors.state(),
        tuple([(r.gram, r.signal) for r in estimator.joint_residuals]),
        None if momentum is None else _take_momentum(momentum),
        None if smoother is None else smoother.told(),
    )


def _take_momentum(momentum: Momentum) -> MomentumSnapshot:
    fit, changes = momentum.fit, momentum.changes
    return MomentumSnapshot(
        tuple(changes.events),
        changes.added,
        changes.adopted,
        momentum.windows,
        momentum.dropped_windows,
        momentum.tracker.state(),
        momentum.bias.state(),
        fit.weights,
        fit.plain.misfit,
        fit.plain.gram,
        fit.plain.windows,
        momentum.test.alarm,
        fit.unexplained,
        momentum.latencies.state(),
    )


def apply(snapshot: Snapshot, replica: Estimator) -> None:
    """Make an estimator of the same system, channels and priors know the same."""
    replica.samples, replica.duration = snapshot.samples, snapshot.duration
    replica.dropped_rows = snapshot.dropped_rows
    vars(replica.counters).update(snapshot.counters)
    replica.energy_tracker.restore(snapshot.energy_tracker)
    replica.shared_errors.restore(snapshot.shared_errors)
    replica.joint_residuals = [SquaredResidual(gram, signal) for gram, signal in snapshot.joint_residuals]
    if snapshot.smoother is not None and replica.smoother is not None:
        replica.smoother.learn(snapshot.smoother)
    known, momentum = snapshot.momentum, replica.momentum
    if known is not None and momentum is not None:
        momentum.follow(known.events, known.added, known.adopted)
        momentum.windows, momentum.dropped_windows = known.windows, known.dropped_windows
        momentum.tracker.restore(known.tracker)
        momentum.bias.restore(known.bias)
        fit = momentum.fit
        fit.weighing.noise.beta, fit.plain.misfit = known.weights, known.misfit
        fit.plain.gram, fit.plain.windows = known.plain_gram, known.plain_windows
        momentum.test.alarm, fit.unexplained = known.alarm, known.unexplained
        momentum.latencies.restore(known.latencies)
