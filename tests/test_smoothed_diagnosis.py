"""Effects named while the smoother estimates, from the samples as they came."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.channels import channels
from sms_online.description.schema import Effect
from sms_online.diagnosis.episodes import line
from sms_online.diagnosis.online import OnlineDiagnosis
from sms_online.diagnosis.online_search import Immediate
from sms_online.diagnosis.searcher import AnyRequest, Named, Outcome, RecordedRequest
from sms_online.diagnosis.smoothed import LEAST, SmoothedDiagnosis, running_diagnosis
from sms_online.effects.build import declaring
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.events import Event
from sms_online.smoother.session import Smoother
from sms_online.smoother.statistics import LARGEST_TORQUE_NOISE
from sms_online.stream import Block
from sms_online.verdict.reasons import lacking
from sms_sim.simulate import sampled_blocks, simulate
from tests.camera_rig import marked_bench

BENCH = marked_bench()
CHANNELS = ("theta_m_1", "q_1", "tau_1", *(f"link_1.marker_{j}.{axis}" for j in (1, 2) for axis in "xy"))
RATE = 125  # Hz
FRICTION = Named(
    effect=Effect(name="coulomb_friction", where="joint_1", coefficients={"torque": 2.0}),
    parameters=(),
    units=(),
    values=np.empty(0),
    stds=np.empty(0),
    coefficients={"torque": (2.0, 0.003, "N m")},
    gain=1e5,
    limit=14.0,
    ambiguous=(),
)


VISCOUS = replace(FRICTION, effect=Effect(name="viscous_friction", where="joint_1", coefficients={"damping": 1.0}))


def found(*named: Named, mistakes: tuple[str, ...] = ()) -> Outcome:
    """What a search says that has found so much."""
    verdict = "mistake" if mistakes else "named" if named else "unexplained"
    return Outcome(verdict, named, {}, 0.1, began=False, beta=np.empty(0), mistakes=mistakes)


class Scripted:
    """A searcher that answers at once with one outcome after the other. requests: what it was asked."""

    def __init__(self, *outcomes: Outcome | None) -> None:
        self.requests: list[RecordedRequest] = []
        self._outcomes = list(outcomes)
        self._done: tuple[int, Outcome | None] | None = None

    @property
    def spans(self) -> list[tuple[float, float]]:
        """Times of the samples that were searched, s."""
        return [(float(each.blocks[0].t[0]), float(each.blocks[-1].t[-1])) for each in self.requests]

    def submit(self, number: int, request: AnyRequest) -> bool:
        assert isinstance(request, RecordedRequest)
        self.requests.append(request)
        self._done = number, self._outcomes.pop(0)
        return True

    def outcome(self, block: int) -> tuple[int, Outcome | None] | None:
        done, self._done = self._done, None
        return done


@pytest.fixture
def refuted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every smoother has one span, whose samples do not agree with the equations."""

    def work(self: Smoother, *_: object, **__: object) -> None:
        self.state.known = self.known._replace(spans=1, level=0.01, mean_square=1.0)

    monkeypatch.setattr(Smoother, "work", work)


def resting(begin: float, end: float) -> Block:
    """Samples of a bench at rest."""
    t = np.arange(begin, end, 1.0 / RATE)
    places = [value for marker in BENCH.links[0].markers for value in marker.position[:2]]
    return Block(t, CHANNELS, np.tile([0.0, 0.0, 0.0, *places], (t.size, 1)))


def watched(searcher: Scripted) -> tuple[Estimator, SmoothedDiagnosis]:
    estimator = Estimator(BENCH, CHANNELS, "bench")
    return estimator, SmoothedDiagnosis(estimator, searcher, "bench", prior=False)


def keys(diagnosis: SmoothedDiagnosis) -> list[str]:
    """What is named in the end."""
    return [named.key for episode in diagnosis.episodes for named in episode.named]


@pytest.mark.usefixtures("refuted")
def test_searches_begin_with_ten_seconds_and_end_when_two_agree() -> None:
    searcher = Scripted(found(FRICTION), found(FRICTION))
    estimator, diagnosis = watched(searcher)
    estimator.push(resting(0.0, 33.0))
    (first, _), (again, end) = searcher.spans
    assert (first, again) == (0.0, 0.0)
    assert end - first > LEAST + 5.0
    assert keys(diagnosis) == ["coulomb_friction@joint_1"]
    assert line(diagnosis.episodes[0]).startswith("samples do not agree with the equations of motion since ")
    assert diagnosis.document()[0]["row"] is None
    assert [effect.key for effect in diagnosis.system.effects] == ["coulomb_friction@joint_1"]
    assert [each.effects for each in diagnosis.discrepancies] == [("coulomb_friction@joint_1",)]


@pytest.mark.usefixtures("refuted")
def test_what_a_later_search_does_not_find_is_withdrawn() -> None:
    searcher = Scripted(found(FRICTION), found(), found())
    estimator, diagnosis = watched(searcher)
    said = list[str]()
    diagnosis.on_verdict = lambda t, text: said.append(text)
    estimator.push(resting(0.0, 12.0))
    assert keys(diagnosis) == ["coulomb_friction@joint_1"]
    estimator.push(resting(12.0, 33.0))
    assert diagnosis.episodes[0].verdict == "unexplained"
    assert diagnosis.discrepancies == ()
    assert len(searcher.spans) == 3
    ends = ["not named yet", "N m)", "not named yet", "no known effect explains"]
    assert all(end in text for end, text in zip(ends, said, strict=True))


@pytest.mark.usefixtures("refuted")
@pytest.mark.parametrize("last", [found(FRICTION), None])
def test_three_searches_that_do_not_agree_name_nothing(last: Outcome | None) -> None:
    searcher = Scripted(found(FRICTION), found(VISCOUS), last)
    estimator, diagnosis = watched(searcher)
    estimator.push(resting(0.0, 33.0))
    assert diagnosis.episodes[0].verdict == "unexplained"
    assert keys(diagnosis) == []
    assert [each["verdict"] for each in diagnosis.document()] == ["unexplained"]


@pytest.mark.usefixtures("refuted")
def test_searches_without_an_answer_say_nothing_of_effects() -> None:
    estimator, diagnosis = watched(Scripted(None, None, None))
    estimator.push(resting(0.0, 33.0))
    assert diagnosis.episodes[0].verdict == "noticed"


@pytest.mark.usefixtures("refuted")
def test_a_mistake_is_said_in_its_words() -> None:
    mistake = "tau_1 looks like mN m in place of N m"
    estimator, diagnosis = watched(Scripted(*[found(FRICTION, mistakes=(mistake,))] * 2))
    estimator.push(resting(0.0, 33.0))
    assert mistake in line(diagnosis.episodes[0])
    (reason,) = lacking(diagnosis.discrepancies)
    assert reason.text == mistake


@pytest.mark.usefixtures("refuted")
def test_samples_before_a_change_are_not_searched() -> None:
    searcher = Scripted(found(FRICTION), found(FRICTION))
    estimator, diagnosis = watched(searcher)
    assert estimator.smoother is not None
    estimator.smoother.state.events = [Event(12.0, "unexplained", (), (), (), (), 2)]
    estimator.push(resting(0.0, 29.0))
    assert [begin for begin, _ in searcher.spans] == pytest.approx([13.0, 13.0], abs=1.0 / RATE)
    assert diagnosis.episodes[0].began == 12.0
    assert [event.time for event in searcher.requests[0].events] == [12.0]


@pytest.mark.usefixtures("refuted")
def test_searches_know_what_changes_have_added() -> None:
    searcher = Scripted(found(VISCOUS), found(VISCOUS))
    estimator, diagnosis = watched(searcher)
    assert estimator.smoother is not None
    estimator.smoother.state.added = ["coulomb_friction@joint_1.torque"]
    estimator.smoother.renew()
    estimator.push(resting(0.0, 33.0))
    added = Effect(name="coulomb_friction", where="joint_1").key
    assert [effect.key for effect in searcher.requests[0].system.effects] == [added]
    assert sorted(effect.key for effect in diagnosis.system.effects) == [added, "viscous_friction@joint_1"]


@pytest.mark.usefixtures("refuted")
def test_no_search_begins_with_the_last_samples() -> None:
    searcher = Scripted()
    estimator, _ = watched(searcher)
    estimator.push(resting(0.0, 10.05))
    estimator.finish()
    assert searcher.spans == []


def test_sessions_without_any_fit_are_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    def work(self: Smoother, *_: object, **__: object) -> None:
        self.state.known = self.known._replace(failures=("0 … 10 s: no motion explains the samples",))

    monkeypatch.setattr(Smoother, "work", work)
    searcher = Scripted(found(FRICTION), found(FRICTION))
    estimator, diagnosis = watched(searcher)
    estimator.push(resting(0.0, 33.0))
    assert keys(diagnosis) == ["coulomb_friction@joint_1"]


def test_nothing_is_searched_where_samples_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    def work(self: Smoother, *_: object, **__: object) -> None:
        self.state.known = self.known._replace(spans=1, level=0.0, mean_square=1.0, torque_noise=LARGEST_TORQUE_NOISE)

    monkeypatch.setattr(Smoother, "work", work)
    searcher = Scripted()
    estimator, _ = watched(searcher)
    estimator.push(resting(0.0, 20.0))
    assert searcher.spans == []


def test_sessions_with_a_momentum_balance_are_watched_by_its_rows() -> None:
    system = sms.load_system("paper-planar")
    estimator = Estimator(system, channels(system), "planar")
    assert isinstance(running_diagnosis(estimator, Immediate(), False, "planar", False), OnlineDiagnosis)


@pytest.mark.long
def test_friction_is_named_while_points_come() -> None:
    """2 N m from the start, seen by points with 0.1 mm of noise; the description is exact but for it."""
    acting = declaring(BENCH, [FRICTION.effect])
    blocks = list(sampled_blocks(simulate(acting, 17.5), None, seed=3))
    session = sms.Session(BENCH, blocks[0].channels)
    for block in blocks:
        session.update(block)
    session.finish()
    (episode,) = session.diagnosis.episodes
    (named,) = episode.named
    assert named.key == "coulomb_friction@joint_1"
    value, std, _ = named.coefficients["torque"]
    assert std is not None
    assert abs(value - 2.0) < 4.0 * std < 0.1
    assert len(episode.evidence) == 2
    assert session.result.trust.reasons[0] == "the model lacks coulomb_friction@joint_1"
    assert "--adopt" not in session.result.trust.next_step
