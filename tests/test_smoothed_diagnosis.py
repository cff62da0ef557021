"""Effects named while the smoother estimates, from the samples as they came."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.channels import channels
from sms_online.description.schema import Effect
from sms_online.diagnosis.episodes import line
from sms_online.diagnosis.online import OnlineDiagnosis
from sms_online.diagnosis.online_search import Immediate
from sms_online.diagnosis.searcher import Named, Outcome, RecordedRequest, Request
from sms_online.diagnosis.smoothed import LEAST, SmoothedDiagnosis, running_diagnosis
from sms_online.effects.build import declaring
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.events import Event
from sms_online.smoother.session import Smoother
from sms_online.smoother.statistics import LARGEST_TORQUE_NOISE
from sms_online.stream import Block
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


class Scripted:
    """A searcher that answers at once with one outcome after the other. spans: of samples that were searched, s."""

    def __init__(self, *named: Sequence[Named]) -> None:
        self.spans: list[tuple[float, float]] = []
        self._named = list(named)
        self._done: tuple[int, Outcome | None] | None = None

    def submit(self, number: int, request: Request | RecordedRequest) -> bool:
        assert isinstance(request, RecordedRequest)
        t = np.concatenate([block.t for block in request.blocks])
        self.spans.append((float(t[0]), float(t[-1])))
        named = tuple(self._named.pop(0))
        verdict = "named" if named else "unexplained"
        self._done = number, Outcome(verdict, named, {}, 0.1, began=False, beta=np.empty(0))
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


@pytest.mark.usefixtures("refuted")
def test_searches_begin_with_ten_seconds_and_end_when_two_agree() -> None:
    searcher = Scripted([FRICTION], [FRICTION])
    estimator, diagnosis = watched(searcher)
    estimator.push(resting(0.0, 40.0))
    (first, _), (again, end) = searcher.spans
    assert (first, again) == (0.0, 0.0)
    assert end - first > LEAST + 5.0
    (episode,) = diagnosis.episodes
    assert [named.key for named in episode.named] == ["coulomb_friction@joint_1"]
    assert line(episode).startswith("samples do not agree with the equations of motion since ")
    assert diagnosis.document()[0]["row"] is None
    assert [effect.key for effect in diagnosis.system.effects] == ["coulomb_friction@joint_1"]


@pytest.mark.usefixtures("refuted")
def test_what_a_later_search_does_not_find_is_withdrawn() -> None:
    searcher = Scripted([FRICTION], [], [])
    estimator, diagnosis = watched(searcher)
    estimator.push(resting(0.0, 12.0))
    assert len(diagnosis.episodes) == 1
    estimator.push(resting(12.0, 60.0))
    assert diagnosis.episodes == []
    assert len(searcher.spans) == 3


@pytest.mark.usefixtures("refuted")
def test_samples_before_a_change_are_not_searched() -> None:
    searcher = Scripted([], [FRICTION], [FRICTION])
    estimator, diagnosis = watched(searcher)
    estimator.push(resting(0.0, 14.0))
    assert estimator.smoother is not None
    estimator.smoother.state.events = [Event(12.0, "unexplained", (), (), (), (), 2)]
    estimator.push(resting(14.0, 40.0))
    assert [begin for begin, _ in searcher.spans[1:]] == pytest.approx([13.0, 13.0], abs=1.0 / RATE)
    assert diagnosis.episodes[0].began == pytest.approx(13.0)


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
