"""What a search of recorded samples answers: the diagnosis itself is replaced, its tests are elsewhere."""

from __future__ import annotations

import pickle
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.schema import Effect
from sms_online.diagnosis import recorded_search
from sms_online.diagnosis.mistakes import Mistake
from sms_online.diagnosis.online_search import search
from sms_online.diagnosis.searcher import REPORTED, RecordedRequest
from sms_online.effects.build import build_model, declaring
from sms_online.errors import InputError
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.events import Event
from sms_online.stream import Block
from tests.camera_rig import marked_bench

BENCH = marked_bench()
EFFECT = Effect(name="coulomb_friction", where="joint_1", coefficients={"torque": 2.0})
ENTRY = {
    "name": EFFECT.name,
    "where": EFFECT.where,
    "coefficients": {"torque": {"estimate": 2.0, "std": 0.1, "unit": "N m"}},
    "ambiguous_with": ["viscous_friction@joint_1"],
    "evidence": {"gain": 100.0, "limit": 14.0},
}
MISTAKE = Mistake("torque_unit", "tau_1", "tau_1 looks like mN m in place of N m", "divide tau_1 by 1000", 9.0, 1.0)


def request(prior: bool = False, events: tuple[Event, ...] = ()) -> RecordedRequest:
    block = Block(np.arange(2.0), ("theta_m_1", "tau_1"), np.zeros((2, 2)))
    return RecordedRequest(BENCH, (block,), "bench", prior, events)


@pytest.fixture
def diagnosed(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """What the next diagnosis finds, to be changed; `prior`: what it was given as known beforehand."""
    now = SimpleNamespace(verdict="named", mistakes=(), left=0.01, entries=[ENTRY], prior=None)
    now.adopted = declaring(BENCH, [EFFECT])
    ranked = [SimpleNamespace(candidate=SimpleNamespace(key=f"effect_{k}"), gain=1.0) for k in range(REPORTED + 3)]
    now.ranking = ranked

    def diagnose(system: sms.System, runs: Any, holdout: Any, source: str, prior: Any, **_: object) -> Any:
        now.prior = prior(SimpleNamespace(base=find_base_parameters(build_model(system))))
        return now, []

    monkeypatch.setattr(recorded_search, "diagnose_recorded", diagnose)
    monkeypatch.setattr(recorded_search, "effects_document", lambda found: found.entries)
    return now


def test_an_effect_found_is_named_with_its_coefficients(diagnosed: SimpleNamespace) -> None:
    outcome = search(pickle.loads(pickle.dumps(request())))
    assert outcome is not None
    (named,) = outcome.named
    assert outcome.verdict == "named"
    assert named.effect == EFFECT
    assert named.coefficients == {"torque": (2.0, 0.1, "N m")}
    assert named.ambiguous == ("viscous_friction@joint_1",)
    assert len(outcome.scores) == REPORTED
    assert diagnosed.prior is None


def test_mistakes_come_before_effects(diagnosed: SimpleNamespace) -> None:
    diagnosed.mistakes = (MISTAKE,)
    outcome = search(request())
    assert outcome is not None
    assert outcome.verdict == "mistake"
    assert outcome.mistakes == (MISTAKE.sentence,)


def test_a_diagnosis_without_an_effect_names_none(diagnosed: SimpleNamespace) -> None:
    diagnosed.entries = []
    outcome = search(request())
    assert outcome is not None
    assert outcome.verdict == "unexplained"


def test_what_has_jumped_is_not_known_beforehand(diagnosed: SimpleNamespace) -> None:
    search(request(prior=True))
    before = diagnosed.prior
    names = [parameter.name for parameter in find_base_parameters(build_model(BENCH)).parameters]
    name = names[np.flatnonzero(np.isfinite(before.std))[0]]
    jump = Event(3.0, "stiffness", (name,), ("",), (1.0,), (0.1,), 2)
    search(request(prior=True, events=(jump,)))
    assert np.count_nonzero(np.isfinite(diagnosed.prior.std)) == np.count_nonzero(np.isfinite(before.std)) - 1


def test_samples_that_allow_for_no_diagnosis_have_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise InputError("bench", "", "too little motion", "more of it")

    monkeypatch.setattr(recorded_search, "diagnose_recorded", refuse)
    assert search(request()) is None
