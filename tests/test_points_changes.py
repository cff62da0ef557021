"""Links that cameras see as points: trackers that follow drifts, and what changes while the session runs."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.bodies import Inertia, RigidBody
from sms_online.description.schema import System
from sms_online.effects.catalogue import parse_effect
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.events import Event
from sms_online.smoother.changes import ALARM, contradicts
from sms_online.smoother.search import DivergedError, SpanFit
from sms_online.smoother.span import Ending
from sms_online.stream import Block
from sms_sim.simulate import simulate
from tests.camera_rig import marked_bench
from tests.changed_session import changed_session, noisy
from tests.saved import resumed
from tests.sessions_of import normalised, session_of

BENCH = marked_bench()
CHANGE, DURATION = 12.4, 19.0  # s
DECIDED = 4.5  # s behind a change: its own span, those behind it, and what the pipeline holds back
PAYLOAD = RigidBody(mass=0.5, center_of_mass=(0.05, 0.02, 0.0), inertia=Inertia(zz=0.01))


def joint_of(system: System, **values: float) -> System:
    return system.model_copy(update={"joints": (system.joints[0].model_copy(update=values),)})


CHANGED = {
    "payload": BENCH.model_copy(update={"payload": PAYLOAD}),
    "stiffness": joint_of(BENCH, stiffness=380.0),
    "friction": BENCH.model_copy(update={"effects": (parse_effect("coulomb_friction@joint_1:torque=2", BENCH),)}),
}
SIZES = {"payload.mass": 0.5, "joint_1.stiffness": -20.0, "coulomb_friction@joint_1.torque": 2.0}


@cache
def changing(kind: str) -> Block:
    return noisy(BENCH, changed_session(simulate(BENCH, DURATION), CHANGED[kind], CHANGE, DURATION), None, 3)


def reported(estimator: Estimator, block: Block) -> list[tuple[float, Event]]:
    """Events of a session, each with the time of the newest sample when it was reported."""
    found: list[tuple[float, Event]] = []
    for piece in block.pieces(50):
        estimator.push(piece)
        found += [(float(piece.t[-1]), event) for event in estimator.events[len(found) :]]
    estimator.finish()
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["payload", *(pytest.param(kind, marks=pytest.mark.long) for kind in ("stiffness", "friction"))]
)
def test_a_change_is_named_with_its_size(kind: str) -> None:
    block = changing(kind)
    estimator = Estimator(BENCH, block.channels, "points")
    ((at, event),) = reported(estimator, block)
    assert event.kind == kind
    assert abs(event.time - CHANGE) <= 1.0
    assert at - CHANGE <= DECIDED
    (name,) = set(SIZES) & set(event.parameters)
    size, std = event.sizes[event.parameters.index(name)], event.stds[event.parameters.index(name)]
    assert abs(size - SIZES[name]) < 4.0 * std < 0.1 * abs(SIZES[name])
    truth = {p.name: p.nominal for p in sms.Session(CHANGED[kind], block.channels).estimator.base.parameters}
    now = estimator.estimate()
    for p, value, deviation in zip(estimator.base.parameters, now.pi, now.std, strict=True):
        assert abs(value - truth.get(p.name, SIZES.get(p.name, np.nan))) < 4.0 * deviation, p.name


@pytest.mark.long
def test_a_session_behind_a_change_is_resumed_to_the_same_bits() -> None:
    block = changing("payload")
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


@pytest.mark.slow
def test_a_change_at_the_end_leaves_the_estimate_of_before() -> None:
    block = changing("stiffness")
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


def test_a_tracker_with_rates_is_refused() -> None:
    with pytest.raises(sms.InputError, match="drifts with a rate, of spans of samples; expected rls, or kalman"):
        sms.Session(BENCH, simulate_channels(), tracker="kalman:drift=learned")


def simulate_channels() -> tuple[str, ...]:
    return sms.simulate(BENCH, 0.5).channels


def span_of(factor: np.ndarray, mean_square: float = 1.0, level: float = 0.0) -> SpanFit:
    n = len(factor) - 1
    ending = Ending(*np.zeros((3, n)), np.zeros((2, 2)), np.zeros((2, n)))
    return SpanFit(factor, np.zeros(n), 100, mean_square, level, 1.0, 0.005, ending)


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
