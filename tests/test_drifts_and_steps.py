"""A step and a drift in one session: each is named for what it is, whichever comes first."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from numpy.testing import assert_allclose

import sms_online as sms
from sms_online.pipeline.changes import DECISION
from sms_online.pipeline.drift_line import DriftLine
from sms_online.pipeline.tracker_bank import LOOKED
from sms_online.stream import Array
from sms_online.trackers import Information, Prior, Rows
from sms_online.trackers.drift import LearnedTrend
from sms_online.trackers.factor import solve, triangular_factor
from tests.axis import AXIS, DAMPING, INERTIA

SYSTEM = sms.load_system(tomllib.loads(AXIS))
STEPPED, SHARE = 0.2, 0.0005  # of the inertia, and what it loses of itself in a second
DAMPED = 0.05  # N m s/rad


def axis_run(
    seconds: float, begin: float, share: float, step: float, heavier: bool, seed: int = 3, damped: float = DAMPED
) -> sms.Capture:
    """The axis along two sines: from `begin`, s, its inertia is lost evenly; at `step`, s, it or its damping grows."""
    t = np.arange(round(200 * seconds)) / 200.0
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    rate, acceleration = 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t), -4 * np.sin(2 * t) - 7.5 * np.sin(5 * t)
    stepped = (t > step).astype(np.float64)
    inertia = INERTIA * (1.0 - share * np.maximum(0.0, t - begin) + STEPPED * heavier * stepped)
    damping = DAMPING + damped * (not heavier) * stepped
    torque = inertia * acceleration - INERTIA * share * (t > begin) * rate + damping * rate
    noise = np.random.default_rng(seed).standard_normal((2, t.size))
    return sms.Capture.from_arrays(t, {"force_1": torque + 0.01 * noise[0], "q_1": q + 1e-4 * noise[1]})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seconds", "begin", "share", "step", "heavier"),
    [(44.0, 30.0, SHARE, 15.0, False), (40.0, 28.0, SHARE, 12.0, True), (34.0, 6.0, 4.0 * SHARE, 24.0, True)],
    ids=["damping-then-drift", "payload-then-drift", "drift-then-payload"],
)
def test_a_step_and_a_drift_are_both_named(
    seconds: float, begin: float, share: float, step: float, heavier: bool
) -> None:
    result = sms.estimate(SYSTEM, axis_run(seconds, begin, share, step, heavier))
    (event,), (drift,) = result.events, result.drifts
    assert event.kind == ("payload" if heavier else "friction")
    assert event.time == pytest.approx(step, abs=0.1)
    assert drift.parameter == "link_1.inertia"
    assert drift.rate < 0.0
    # What was lost by then is the link's, and nothing of it the payload's.
    expected = {"link_1.inertia": INERTIA * (1.0 - share * (seconds - begin))}
    expected |= {"payload.inertia": INERTIA * STEPPED} if heavier else {}
    for name, value in expected.items():
        found = result.parameters[name]
        assert found.value == pytest.approx(value, abs=0.004 * INERTIA), name
    whole = sum(result.parameters[name].value for name in expected)
    assert whole == pytest.approx(sum(expected.values()), abs=0.002 * INERTIA)
    assert result.trust.level == "trust"


@pytest.mark.long
def test_the_line_of_a_young_drift_is_renewed_sooner() -> None:
    """Its rate is hardly known: rows of a second later, less such a line, would hold more than noise."""
    session = sms.Session(SYSTEM, ("force_1", "q_1"))
    lines: list[DriftLine] = []
    for block in axis_run(14.0, 6.0, 60.0 * SHARE, np.inf, False):
        for piece in block.pieces(20):
            session.update(piece)
            momentum = session.estimator.momentum
            line = None if momentum is None else momentum.state.drift
            if line is not None and (not lines or line.t != lines[-1].t):
                lines.append(line)
    holds = [line.due - line.t for line in lines]
    assert holds[0] < 0.5 * LOOKED
    assert holds[0] == min(holds)
    assert max(holds) <= LOOKED


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_weak_drift_after_a_long_steady_stretch_is_no_step(seed: int) -> None:
    """It had run for three seconds before the alarm; the next one is looked at as soon as ever."""
    data = axis_run(46.0, 34.0, 2.0 * SHARE, np.inf, False, seed)
    session = sms.Session(SYSTEM, data.channels)
    for block in data:
        session.update(block)
    session.finish()
    result, momentum = session.result, session.estimator.momentum
    assert momentum is not None
    assert momentum.changes.state.wanted == DECISION
    (drift,) = result.drifts
    assert result.events == ()
    assert drift.parameter == "link_1.inertia"
    assert drift.since == pytest.approx(34.0, abs=1.5)
    # Its start is known to a second, of twelve.
    assert drift.rate == pytest.approx(-2.0 * SHARE * INERTIA, rel=0.15)
    assert result.parameters["link_1.inertia"].value == pytest.approx(INERTIA * (1.0 - 24.0 * SHARE), rel=0.002)


LATE_ALARMS = [
    (2, 15.30, 0.0061),
    *(pytest.param(*each, marks=pytest.mark.long) for each in ((3, 15.24, 0.0047), (7, 15.90, 0.0090))),
]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "step", "size"), LATE_ALARMS)
def test_a_small_step_is_no_drift(seed: int, step: float, size: float) -> None:
    """Its alarm comes up to a second late, so that ramps from before it explain the rows nearly as well."""
    result = sms.estimate(SYSTEM, axis_run(23.0, np.inf, 0.0, step, False, seed, damped=size))
    (event,) = result.events
    assert result.drifts == ()
    assert event.kind == "friction"
    assert event.time == pytest.approx(step, abs=0.15)
    assert result.trust.level == "trust"


@pytest.mark.slow
@pytest.mark.parametrize("tracker", ["rls:forgetting=exponential,memory=5", "kalman:drift=random_walk,share=1e-3"])
def test_a_step_is_named_beside_a_tracker_that_lets_all_move(tracker: str) -> None:
    result = sms.estimate(SYSTEM, axis_run(20.0, np.inf, 0.0, 12.0, False), tracker=tracker)
    (event,) = result.events
    assert event.kind == "friction"
    assert event.time == pytest.approx(12.0, abs=0.1)
    assert event.sizes[0] == pytest.approx(DAMPED, abs=4.0 * event.stds[0])


@pytest.mark.long
def test_a_session_restored_behind_a_step_and_a_drift_goes_on_to_the_same_bits() -> None:
    """With a prior, which is within what was known at the step, and again within what the drift went on from."""
    data = axis_run(44.0, 30.0, SHARE, 15.0, False)
    prior = sms.estimate(SYSTEM, axis_run(8.0, np.inf, 0.0, np.inf, False, seed=7))
    expected = sms.estimate(SYSTEM, data, prior=prior)
    assert len(expected.events) == len(expected.drifts) == 1
    session, waiting = sms.Session(SYSTEM, data.channels, prior=prior), 0
    for block in data:
        for piece in block.pieces(200):
            session.update(piece)
            session = sms.Session.restore(session.save())
            assert session.estimator.momentum is not None
            waiting += session.estimator.momentum.changes.detector.alarm is not None
    assert waiting
    session.finish()
    assert session.result.parameters == expected.parameters
    assert (session.result.events, session.result.drifts) == (expected.events, expected.drifts)


def test_what_is_unknown_holds_nothing_of_a_residual() -> None:
    """The residual of a column of zeros' row would count for the first rows that know it."""
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(40, 5))
    rows[:, 1] = 0.0
    factor = triangular_factor(rows)
    assert_allclose(factor.T @ factor, rows.T @ rows, atol=1e-12)
    assert not factor[1].any()
    assert factor[-1, -1] ** 2 == pytest.approx(solve(rows).rss)


def known_apart(rng: np.random.Generator) -> Information:
    """What a hundred rows say of two parameters, and nothing of a third."""
    Y = rng.normal(size=(100, 2)) / 0.02
    rows = np.column_stack((Y, np.zeros(100), Y @ [1.0, 2.0] + rng.normal(size=100)))
    return Information.none(3).with_rows(rows)


def two_names(rng: np.random.Generator, lost: float) -> tuple[LearnedTrend, Array]:
    """A tracker behind rows that know two parameters, then rows whose third column is the first once more."""
    tracker = LearnedTrend(3, ((0,), (1,), (2,)), *np.zeros((2, 3)), Prior(np.zeros(3), np.full(3, np.nan)))
    tracker.begin(known_apart(rng).without([2]))
    t = np.arange(600) / 20.0 + 0.013
    Y = rng.normal(size=(t.size, 2))[:, [0, 1, 0]] / 0.02
    truth = np.array([1.0, 2.0, 0.5]) - np.outer(t, [lost, 0.0, 0.0])
    tracker.update(Rows(Y, np.sum(Y * truth, axis=1) + rng.normal(size=t.size), np.ones(t.size), t))
    return tracker, truth[-1]


def test_rows_before_are_no_lack_of_those_behind() -> None:
    tracker, truth = two_names(np.random.default_rng(1), 0.0)
    assert not tracker.state.lacking
    assert tracker.found == ()
    assert tracker.state.suspected is None
    estimate = tracker.estimate()
    assert_allclose(estimate.pi, truth, atol=4.0 * float(np.max(estimate.std)))


def test_of_two_names_for_one_drift_the_first_counts() -> None:
    tracker, truth = two_names(np.random.default_rng(1), 0.01)
    (drift,) = tracker.found
    assert drift.column == 0
    assert drift.rate == pytest.approx(-0.01, abs=4.0 * drift.std)
    assert tracker.state.suspected is None
    estimate = tracker.estimate()
    assert estimate.pi[1] == pytest.approx(truth[1], abs=4.0 * estimate.std[1])
    # How much of the sum was the first before its drift showed is not known as well.
    assert estimate.pi[0] + estimate.pi[2] == pytest.approx(truth[0] + truth[2], abs=4.0 * estimate.std[0])


def test_a_lack_does_not_outlive_what_showed_it() -> None:
    """Rows of twice their stated noise at first, then of their own: as many again, and the memory holds these alone."""
    rng, N = np.random.default_rng(2), 2
    tracker = LearnedTrend(N, ((0,), (1,)), *np.zeros((2, N)), Prior(np.zeros(N), np.full(N, np.nan)))
    t = np.arange(1000) / 20.0 + 0.013
    Y, noise = rng.normal(size=(t.size, N)), rng.normal(size=t.size) * np.where(t < 10.0, 2.0, 1.0)
    rows = Rows(Y, Y @ [1.0, 2.0] + noise, np.ones(t.size), t)
    lacking = []
    for k in range(0, t.size, 20):
        part = slice(k, k + 20)
        tracker.update(Rows(rows.Y[part], rows.b[part], rows.std[part], rows.t[part]))
        lacking.append(tracker.state.lacking)
    assert any(lacking[:12])
    assert not lacking[-1]
