"""The statistics of a running session, taken from its estimator.

Taking them costs microseconds: what is large is shared, for the estimator writes such arrays once.
"""

from __future__ import annotations

from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.momentum import Momentum
from sms_online.pipeline.statistics import MomentumStatistics, Statistics
from sms_online.row_types import joint_rows
from sms_online.state import snapshot, state_copy


def statistics_of(estimator: Estimator, at: float | None = None) -> Statistics:
    """The statistics of a session up to now; nothing in them changes as it goes on.

    at: instant, s, that parameters which drift hold for; by default that of the newest sample.
    """
    momentum, smoother = estimator.momentum, estimator.smoother
    return Statistics(
        setup=estimator.setup,
        method=estimator.method,
        finished=estimator.finished,
        samples=estimator.samples,
        duration=estimator.duration,
        dropped_rows=estimator.energy.state.dropped_rows,
        counters=state_copy(estimator.counters),
        outliers=estimator.outliers,
        swaps=tuple(estimator.swaps),
        last_time=estimator.last_time,
        periods=estimator.periods.copy(),
        events=tuple(estimator.events),
        readings=estimator.readings(estimator.end if at is None else at),
        energy=snapshot(estimator.energy.tracker),
        shared=state_copy(estimator.energy.shared),
        joints=tuple(state_copy(estimator.energy.joint_residuals)),
        momentum=None if momentum is None else _of_momentum(momentum),
        smoother=None if smoother is None else smoother.known,
    )


def _of_momentum(momentum: Momentum) -> MomentumStatistics:
    """The same of a momentum balance."""
    alarm, noise = momentum.test.alarm, momentum.sensor_noise
    return MomentumStatistics(
        reference=momentum.reference,
        tracker=snapshot(momentum.joint.tracker),
        bias=state_copy(momentum.joint.bias),
        rows=state_copy(momentum.fit.plain),
        started=momentum.started,
        tested=momentum.testable,
        alarm=None if alarm is None else alarm.row,
        passing=_passing(momentum),
        short=alarm is not None and not momentum.test.persistence.decides,
        scale_free=momentum.joint.scale_free(momentum.fit),
        latency=momentum.latencies.found,
        coloured={} if noise is None else noise.coloured,
        jitters={} if noise is None else {each.name: each.std for each in noise.jitters},
        suspected=momentum.bank.suspected,
        shifts=tuple(momentum.changes.shifts),
        unwatched=momentum.bank.unwatched,
        point=momentum.point(),
    )


def _passing(momentum: Momentum) -> dict[str, tuple[str, float]]:
    """See `MomentumStatistics`; where rows alarm and no parameter moves."""
    noise, sensing = momentum.sensor_noise, momentum.sensing
    if noise is None or momentum.test.alarm is None or momentum.reference is not None:
        return {}
    passing = momentum.test.persistence.passing(momentum.joint.solved(momentum.fit).pi)
    driven = [i for i, joint in enumerate(sensing.model.system.joints) if not joint.passive]
    stds = noise.grid[len(sensing.position_columns) :].tolist()
    torques = zip(driven, sensing.torque_columns, stds, strict=True)
    return {joint_rows(i): (sensing.channels[column], std) for i, column, std in torques if passing[i]}
