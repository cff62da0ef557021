"""Effects noticed, named and added to the model while a session runs; the same however its samples come."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.schema import LEAST_SQUARES, Effect, System
from sms_online.diagnosis.online import OnlineDiagnosis
from sms_online.diagnosis.online_search import Immediate
from sms_online.diagnosis.searcher import Outcome, Request
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.snapshot import statistics_of
from sms_online.stream import Block
from sms_sim.simulate import Simulation
from tests.axis import DAMPING, INERTIA
from tests.axis_effects import BARE, COGGING, PHASE, SYSTEM, axis_block, cogging, nothing
from tests.changed_session import changed_session, noisy
from tests.evaluated import elsewhere, results_document
from tests.saved import resumed

PLANAR = load_system("paper-planar")
BEGIN = 8.0  # s
FRICTION = 0.05  # N m


def watched(system: System, block: Block, adopt: bool = True, size: int = 64) -> tuple[Estimator, OnlineDiagnosis]:
    estimator = Estimator(system, block.channels, "test")
    online = OnlineDiagnosis(estimator, Immediate(), adopt)
    for piece in block.pieces(size):
        estimator.push(piece)
    estimator.finish()
    return estimator, online


@cache
def cogged(adopt: bool) -> tuple[Estimator, OnlineDiagnosis]:
    return watched(SYSTEM, axis_block(cogging, BEGIN), adopt)


def estimated(estimator: Estimator) -> dict[str, tuple[float, float]]:
    estimate = estimator.estimate()
    names = [p.name for p in estimator.base.parameters]
    return dict(zip(names, zip(estimate.pi.tolist(), estimate.std.tolist(), strict=True), strict=True))


def document(estimator: Estimator, online: OnlineDiagnosis) -> str:
    return json.dumps([results_document(estimator, 0.0, []), online.document()])


@pytest.mark.long
def test_an_effect_of_the_base_that_begins_is_named(
    planar_session: Simulation,
) -> None:
    """A drag of 60 N s/m at grade B, seed 1: noticed within 2 s of data, named within 5 s, then known like the rest."""
    drag = Effect(name="air_drag", where="base", coefficients={"damping": 60.0})
    changed = PLANAR.model_copy(update={"effects": (drag,)})
    block = noisy(PLANAR, changed_session(planar_session, changed, BEGIN, BEGIN + 3.5), "B", 1)
    estimator, online = watched(PLANAR, block, size=80)
    (episode,) = online.episodes
    assert episode.row == "base"
    assert BEGIN < episode.noticed < BEGIN + 2.0
    assert episode.named_at is not None
    assert episode.named_at < BEGIN + 5.0
    assert [named.key for named in episode.named] == ["air_drag@base"]
    assert episode.adopted is not None
    (event,) = estimator.events
    assert (event.kind, event.parameters) == ("effect", ("air_drag@base.damping",))
    assert event.time == pytest.approx(BEGIN, abs=0.15)
    base = find_base_parameters(build_model(PLANAR))
    true = np.append(base.values(build_model(PLANAR).nominal), 60.0)
    estimate = estimator.estimate()
    assert (np.abs(estimate.pi - true) < 4.0 * estimate.std).all()
    assert estimate.pi[-1] == pytest.approx(60.0, rel=1e-3)


@pytest.mark.slow
def test_an_effect_that_begins_is_dated_sized_and_adopted() -> None:
    estimator, online = cogged(True)
    (episode,) = online.episodes
    assert episode.verdict == "named"
    assert episode.noticed < BEGIN + 2.0
    assert episode.began == pytest.approx(BEGIN, abs=0.4)
    (named,) = episode.named
    assert named.key == "cogging@joint_1"
    amplitude, phase = (named.coefficients[name] for name in ("amplitude", "phase"))
    assert amplitude[0] == pytest.approx(COGGING, abs=4.0 * (amplitude[1] or 0.0))
    assert phase[0] == pytest.approx(PHASE, abs=4.0 * (phase[1] or 0.0))
    found = estimated(estimator)
    for name, true in (("link_1.inertia", INERTIA), ("cogging@joint_1.cosine", COGGING * np.cos(PHASE))):
        assert found[name][0] == pytest.approx(true, abs=4.0 * found[name][1])
    assert not estimator.momentum.misfit


@pytest.mark.slow
def test_without_adopt_it_is_only_reported() -> None:
    estimator, online = cogged(False)
    (episode,) = online.episodes
    assert (episode.verdict, episode.adopted) == ("named", None)
    assert [named.key for named in episode.named] == ["cogging@joint_1"]
    assert [p.name for p in estimator.base.parameters] == ["link_1.inertia", "viscous_friction@joint_1.damping"]
    assert "added to the model" not in online.notices[0]
    plain = Estimator(SYSTEM, ("force_1", "q_1"), "plain")
    plain.push(axis_block(cogging, BEGIN))
    plain.finish()
    assert results_document(plain, 0.0, []) == results_document(estimator, 0.0, [])


def test_an_effect_from_the_start_is_named_and_leaves_no_bias() -> None:
    """Friction that the description lacks: noticed as soon as there are weights, named at the first search."""
    estimator, online = watched(BARE, axis_block(nothing, seconds=9.0))
    (episode,) = online.episodes
    assert episode.began is None
    assert episode.noticed < 4.0
    assert [named.key for named in episode.named] == ["viscous_friction@joint_1"]
    found = estimated(estimator)
    for name, true in (("link_1.inertia", INERTIA), ("viscous_friction@joint_1.damping", DAMPING)):
        assert found[name][0] == pytest.approx(true, abs=4.0 * found[name][1])


@pytest.mark.slow
@pytest.mark.parametrize("rest", [2.0, pytest.param(10.0, marks=pytest.mark.long)])
def test_friction_behind_a_rest_is_named_as_by_rls(rest: float) -> None:
    """Rows at rest show neither a drift nor what the model lacks: no motion that follows them is an event."""
    block = rested(rest)
    (first, learned), (second, squares) = (
        watched(system, block, adopt=False)
        for system in (SYSTEM, SYSTEM.model_copy(update={"trackers": (LEAST_SQUARES,)}))
    )
    assert estimated(first) == estimated(second)
    assert first.events == second.events == []
    (episode,), (other,) = learned.episodes, squares.episodes
    assert (episode.verdict, episode.began) == (other.verdict, other.began) == ("named", pytest.approx(rest, abs=1.0))
    assert [named.key for named in episode.named] == ["coulomb_friction@joint_1"]
    assert episode.named_at is not None
    assert episode.named_at < rest + 5.0


def rested(rest: float) -> Block:
    """The axis at rest for so many seconds, and then with friction along two sines."""
    moved = axis_block(lambda q, rate: FRICTION * np.sign(rate), seconds=8.0)
    count = round(rest / (moved.t[1] - moved.t[0]))
    still = np.random.default_rng(6).standard_normal((count, 2)) * [0.01, 1e-4] + [0.0, moved.values[0, 1]]
    values = np.concatenate((still, moved.values))
    return Block(np.arange(len(values)) * moved.t[1], moved.channels, values)


@pytest.mark.slow
def test_the_evidence_grows_with_the_samples() -> None:
    _, online = cogged(True)
    episode = online.document()[0]
    first, second = episode["evidence"]
    assert first["time"] < second["time"] <= episode["adopted"]
    assert second["candidates"]["cogging@joint_1"] > first["candidates"]["cogging@joint_1"]
    assert max(second["candidates"], key=second["candidates"].get) == "cogging@joint_1"
    assert episode["effects"][0]["evidence"]["gain"] > episode["effects"][0]["evidence"]["limit"]


@pytest.mark.slow
def test_a_session_without_anything_missing_says_nothing() -> None:
    estimator, online = watched(SYSTEM, axis_block(nothing))
    assert online.document() == []
    assert online.system == SYSTEM
    assert estimator.momentum is not None
    assert estimator.momentum.test.alarm is None


@pytest.mark.slow
def test_a_change_that_an_event_explains_is_named_by_it() -> None:
    """Friction twice as high: the event's jump says so, whatever a search made of the first windows."""
    block = axis_block(lambda q, rate: DAMPING * rate, BEGIN)
    estimator, online = watched(SYSTEM, block)
    (episode,) = online.episodes
    assert episode.verdict == "change"
    assert episode.event == estimator.events[0]
    assert "viscous_friction@joint_1.damping" in online.notices[0]


@pytest.mark.slow
def test_an_event_that_is_decided_late_closes_what_was_named() -> None:
    """Two searches name the friction while it may be a drift; then an event goes on with it."""
    estimator, online = watched(SYSTEM, axis_block(lambda q, rate: FRICTION * np.sign(rate), BEGIN, 13.0), adopt=False)
    (event,), (episode,) = estimator.events, online.episodes
    assert event.kind == "friction"
    assert [evidence.outcome.keys for evidence in episode.evidence] == [("coulomb_friction@joint_1",)] * 2
    assert (episode.verdict, episode.event, episode.named) == ("change", event, ())


class _Overwhelmed(Immediate):
    """A searcher that finds more lacking than it may look for."""

    def __init__(self) -> None:
        super().__init__()
        self.durations: list[float] = []

    def submit(self, number: int, request: Request) -> bool:
        self.durations.append(sum(s.index.size for s in request.segments) / request.model.system.sample_rate)
        lacking = Outcome("unexplained", (), {}, 0.5, began=False, beta=request.beta, ended=True)
        self._done = number, lacking
        return True


@pytest.mark.slow
def test_where_too_much_is_lacking_only_the_whole_record_is_searched_again() -> None:
    block = axis_block(cogging, seconds=20.0)
    estimator = Estimator(SYSTEM, block.channels, "test")
    searcher = _Overwhelmed()
    online = OnlineDiagnosis(estimator, searcher, adopt=False)
    estimator.push(block)
    estimator.finish()
    first, last = searcher.durations
    assert last > 3.0 * first
    assert online.episodes[0].verdict == "unexplained"


@pytest.mark.long
def test_what_no_effect_explains_is_said_to_be_unexplained() -> None:
    """A torque that depends on time alone, from the start."""
    _, online = watched(SYSTEM, _with_torque(axis_block(nothing, seconds=20.0)))
    (episode,) = online.episodes
    assert episode.verdict == "unexplained"
    assert episode.named == ()
    assert online.system == SYSTEM


def _with_torque(block: Block) -> Block:
    values = block.values.copy()
    values[:, 0] += 0.3 * np.sin(9.0 * block.t) + 0.2 * np.sin(3.1 * block.t)
    return Block(block.t, block.channels, values)


@pytest.mark.slow
def test_nothing_depends_on_how_samples_arrive() -> None:
    assert document(*watched(SYSTEM, axis_block(cogging, BEGIN), size=1)) == document(*cogged(True))


@pytest.mark.slow
def test_a_session_with_an_adopted_effect_resumes_to_the_bit() -> None:
    block = axis_block(cogging, BEGIN)
    split = 13 * 200
    first, second = (Block(block.t[part], block.channels, block.values[part]) for part in np.s_[:split, split:])
    running = Estimator(SYSTEM, block.channels, "running")
    OnlineDiagnosis(running, Immediate(), adopt=True)
    running.push(first)
    assert running.momentum is not None
    assert [effect.name for effect in running.momentum.changes.adopted] == ["cogging"]
    continued = resumed(Estimator(SYSTEM, block.channels, "continued"), running)
    running.observers.clear()
    for estimator in (running, continued):
        estimator.push(second)
        estimator.finish()
    assert results_document(continued, 0.0, []) == results_document(running, 0.0, [])


@pytest.mark.slow
def test_pickled_statistics_say_the_same_after_an_adoption() -> None:
    estimator, _ = cogged(True)
    assert elsewhere(statistics_of(estimator)) == results_document(estimator, 0.0, [])
