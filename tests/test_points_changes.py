"""Links that cameras see as points: trackers that follow drifts, and what changes while the session runs."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.bodies import Inertia, RigidBody
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import parse_effect
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.events import Event
from sms_online.smoother.changes import ALARM, contradicts
from sms_online.smoother.gauss_newton import DivergedError
from sms_online.smoother.search import SpanFit
from sms_online.smoother.span import Ending
from sms_online.stream import Block
from sms_online.verdict.gather import repeated
from sms_sim.simulate import simulate
from tests.camera_rig import marked_bench, readings_off, seen_by_cameras
from tests.changed_session import changed_session, noisy
from tests.saved import resumed
from tests.sessions_of import normalised, session_of

BENCH, PLANAR, SPATIAL = marked_bench(), seen_by_cameras("paper-planar"), seen_by_cameras("spatial-two-link")
CHANGE, DURATION = 12.4, 19.0  # s
DECIDED = 4.5  # s behind a change: its own span, those behind it, and what the pipeline holds back


def carrying(system: System, mass: float, size: float) -> System:
    """With a payload whose centre of mass and radius of gyration are about `size`, m, from the tip."""
    about = mass * size**2
    body = RigidBody(mass=mass, center_of_mass=(size, 0.3 * size, 0.0), inertia=Inertia(xx=about, yy=about, zz=about))
    return system.model_copy(update={"payload": body})


def joint_of(system: System, i: int, **shares: float) -> System:
    """With values of a joint multiplied by their shares."""
    joints = list(system.joints)
    values = {name: share * getattr(joints[i], name) for name, share in shares.items()}
    joints[i] = joints[i].model_copy(update=values)
    return system.model_copy(update={"joints": tuple(joints)})


def rubbing(system: System, effect: str) -> System:
    return system.model_copy(update={"effects": (parse_effect(effect, system),)})


# Lighter bodies at the undamped tip ring at frequencies that the collocation does not resolve, see docs.
# Before and behind each change, its kind, and the parameter that says most of it.
CHANGES = {
    "one link, 0.5 kg": (BENCH, carrying(BENCH, 0.5, 0.2), "payload", "payload.mass"),
    "one link, spring -5 %": (BENCH, joint_of(BENCH, 0, stiffness=0.95), "stiffness", "joint_1.stiffness"),
    "one link, 2 N m": (
        BENCH, rubbing(BENCH, "coulomb_friction@joint_1:torque=2"), "friction", "coulomb_friction@joint_1.torque",
    ),
    "planar, 3 kg": (PLANAR, carrying(PLANAR, 3.0, 0.2), "payload", "payload.mass"),
    "planar, 20 kg": (PLANAR, carrying(PLANAR, 20.0, 0.2), "payload", "payload.mass"),
    "planar, 0.2 kg released": (carrying(PLANAR, 0.2, 0.1), PLANAR, "payload", "payload.mass"),
    "planar, spring -30 %": (PLANAR, joint_of(PLANAR, 1, stiffness=0.7), "stiffness", "joint_2.stiffness"),
    "planar, damper +2 %": (PLANAR, joint_of(PLANAR, 0, damping=1.02), "damping", "joint_1.damping"),
    "planar, 5 N m": (
        PLANAR, rubbing(PLANAR, "coulomb_friction@joint_2:torque=5"), "friction", "coulomb_friction@joint_2.torque",
    ),
    "spatial, 3 kg for 8 kg": (SPATIAL, carrying(SPATIAL, 3.0, 0.2), "payload", "payload.mass"),
    # It moves faster behind it than the usual steps and derivatives follow.
    "spatial, spring -30 %": (SPATIAL, joint_of(SPATIAL, 0, stiffness=0.7), "stiffness", "joint_1.stiffness"),
    "spatial, damper +5 %": (SPATIAL, joint_of(SPATIAL, 0, damping=1.05), "damping", "joint_1.damping"),
}  # fmt: skip
QUICKEST = "one link, spring -5 %"


@cache
def changing(case: str) -> Block:
    before, after, _, _ = CHANGES[case]
    return noisy(before, changed_session(simulate(before, DURATION), after, CHANGE, DURATION), None, 3)


def reported(estimator: Estimator, block: Block) -> list[tuple[float, Event]]:
    """Events of a session, each with the time of the newest sample when it was reported."""
    found: list[tuple[float, Event]] = []
    for piece in block.pieces(50):
        estimator.push(piece)
        found += [(float(piece.t[-1]), event) for event in estimator.events[len(found) :]]
    estimator.finish()
    return found


def true_values(system: System) -> dict[str, float]:
    return {p.name: p.nominal for p in build_model(system).parameters}


def check_parameters(estimator: Estimator, system: System) -> None:
    """That all parameters are those of a system, within four standard deviations."""
    now, truth = estimator.estimate(), true_values(system)
    expected = estimator.base.values(np.array([truth.get(p.name, 0.0) for p in estimator.model.parameters]))
    assert np.all(np.abs(now.pi - expected) < 4.0 * now.std)


def check_named(case: str, described: System, block: Block) -> None:
    """That the only event of a session is the change of a case, with its size, and the parameters behind it hold."""
    before, after, kind, name = CHANGES[case]
    estimator = Estimator(described, block.channels, "points")
    ((at, event),) = reported(estimator, block)
    assert event.kind == kind
    assert abs(event.time - CHANGE) <= 1.0
    assert at - CHANGE <= DECIDED
    jump = true_values(after).get(name, 0.0) - true_values(before).get(name, 0.0)
    size, std = event.sizes[event.parameters.index(name)], event.stds[event.parameters.index(name)]
    assert abs(size - jump) < 4.0 * std < 0.1 * abs(jump)
    check_parameters(estimator, after)


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=pytest.mark.slow if case == QUICKEST else pytest.mark.long) for case in CHANGES],
)
def test_a_change_is_named_with_its_size(case: str) -> None:
    check_named(case, CHANGES[case][0], changing(case))


@pytest.mark.long
@pytest.mark.parametrize("case", [case for case in CHANGES if case.startswith("planar")])
def test_a_change_is_named_where_readings_are_off(case: str) -> None:
    check_named(case, *readings_off(CHANGES[case][0], changing(case), 1))


@pytest.mark.long
def test_what_is_grasped_and_released_leaves_what_was_before() -> None:
    exact = changed_session(simulate(PLANAR, 28.0), carrying(PLANAR, 3.0, 0.2), CHANGE, 28.0, back=21.3)
    described, block = readings_off(PLANAR, noisy(PLANAR, exact, None, 5), 2)
    estimator = session_of(described, [block])
    assert [event.kind for event in estimator.events] == ["payload", "payload"]
    for event, mass in zip(estimator.events, (3.0, -3.0), strict=True):
        mass_at = event.parameters.index("payload.mass")
        assert abs(event.sizes[mass_at] - mass) < 4.0 * event.stds[mass_at] < 0.01
    check_parameters(estimator, PLANAR)


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_nothing_changes_where_readings_are_off(seed: int) -> None:
    data = sms.simulate(PLANAR, 30.0, seed=seed)
    described, block = readings_off(PLANAR, Block(data.t, data.channels, data.values), seed)
    estimator = session_of(described, [block])
    assert not estimator.events
    assert estimator.smoother is not None
    assert not estimator.smoother.known.failures


@pytest.mark.long
def test_a_session_behind_a_change_is_resumed_to_the_same_bits() -> None:
    block = changing("one link, 0.5 kg")
    whole = session_of(BENCH, [block])
    before = Estimator(BENCH, block.channels, "points")
    pieces = list(block.pieces(500))
    begun = 0
    while not before.events:
        before.push(pieces[begun])
        begun += 1
    after = resumed(Estimator(BENCH, block.channels, "points"), before)
    after_block = pieces[begun:]
    for piece in after_block:
        after.push(piece)
    after.finish()
    assert after.events == whole.events
    assert np.array_equal(after.estimate().pi, whole.estimate().pi)


@pytest.mark.long
def test_a_change_at_the_end_leaves_the_estimate_of_before() -> None:
    block = changing("one link, spring -5 %")
    kept = block.t <= CHANGE + 0.9
    estimator = session_of(BENCH, [Block(block.t[kept], block.channels, block.values[kept])])
    (event,) = estimator.events
    assert event.kind == "undecided"
    assert np.all(np.abs(normalised(estimator)) < 4.0)


@pytest.mark.long
def test_trackers_follow_what_drifts() -> None:
    data = sms.simulate(BENCH, 32.0, seed=1, drift=["joint_1.damping:share=0.02,over=20,begin=12"])
    trackers = ["kalman:drift=random_walk,share=0.001", "rls:forgetting=window,memory=4", "rls"]
    result = sms.estimate(BENCH, data, tracker=trackers)
    assert result.method == "smoother"
    walk, window, squares = (each.parameters["joint_1.damping"] for each in result.trackers)
    assert abs(walk.value - 10.2) < 4.0 * walk.std < 0.1
    # A mean over the last seconds, and over all.
    assert abs(squares.value - 10.2) > abs(window.value - 10.2)
    assert result.parameters["joint_1.damping"].value == walk.value
    assert not result.events


@pytest.mark.long
def test_a_drift_that_nobody_follows_is_said() -> None:
    data = sms.simulate(BENCH, 30.0, seed=1, drift=["joint_1.damping:share=0.05,over=16,begin=12"])
    result = sms.estimate(BENCH, data)
    assert {event.parameters for event in result.events} == {("joint_1.damping",)}
    assert "joint_1.damping has jumped the same way" in result.trust.sentence
    assert "kalman:drift=random_walk,share=0.001" in result.trust.next_step
    assert not result.trust.grave


def test_a_tracker_with_rates_is_refused() -> None:
    with pytest.raises(sms.InputError, match="drifts with a rate, of spans of samples; expected rls, or kalman"):
        sms.Session(BENCH, simulate_channels(), tracker="kalman:drift=learned")


def simulate_channels() -> tuple[str, ...]:
    return sms.simulate(BENCH, 0.5).channels


def span_of(factor: np.ndarray, mean_square: float = 1.0, level: float = 0.0) -> SpanFit:
    n = len(factor) - 1
    ending = Ending(*np.zeros((3, n)), np.zeros((2, 2)), np.zeros((2, n)))
    return SpanFit(factor, np.zeros(n), 100, mean_square, level, 1.0, 0.005, ending)


def test_jumps_of_one_kind_are_a_series_where_they_go_one_way() -> None:
    first = Event(14.0, "damping", ("joint_1.damping",), ("N m s/rad",), (0.1,), (0.01,), 2)
    other_way, other = replace(first, sizes=(-0.1,)), replace(first, parameters=("joint_1.stiffness",))
    grasped = replace(first, kind="payload", parameters=("payload.mass",))
    assert repeated([other, first, first, first]) == ("joint_1.damping",)
    for events in ([first, first], [first, other_way, first], [first, other, first], 3 * [grasped]):
        assert repeated(events) == ()


def test_a_span_contradicts_what_it_is_far_from() -> None:
    n = 3
    known, span = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1))
    known[:n, :n] = 1e3 * np.eye(n)
    span[:n, :n] = np.eye(n)
    assert not contradicts(known, span_of(span))
    # χ² of three rows: as far in one direction as the limit allows, or a little further.
    limit = np.sqrt(n + ALARM * np.sqrt(2.0 * n))
    for share, expected in ((0.99, False), (1.01, True)):
        span[0, n] = share * limit
        assert contradicts(known, span_of(span)) is expected
    span[0, n] = 0.0
    assert contradicts(known, span_of(span, mean_square=2.0))
    assert contradicts(known, span_of(span, level=0.01))
    assert contradicts(known, DivergedError("no motion"))
