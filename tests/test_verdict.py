"""What a diagnosis may say: verdicts of made-up residuals, links that stiffen, axes at rest."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.schema import Effect, System
from sms_online.diagnosis import exact_links
from sms_online.diagnosis.candidate import Candidate
from sms_online.diagnosis.hypothesis import verdict
from sms_online.diagnosis.improvement import predicts_worse, supported
from sms_online.diagnosis.record import Segment
from sms_online.diagnosis.residuals import RowResidual
from sms_online.diagnosis.reversals import Reversals
from sms_online.diagnosis.standstill import SessionStandstill
from sms_online.diagnosis.weak_windows import SeenMotion
from sms_online.effects.build import declaring
from sms_online.effects.catalogue import ENTRIES
from sms_online.pipeline.smoothing import smooth
from sms_online.pipeline.standstill import Standstill, rate_filter, slowest
from tests.axis_effects import SYSTEM, axis_block, nothing
from tests.sessions_of import session_of


def _found(name: str, where: str) -> Candidate:
    return Candidate(Effect(name=name, where=where), (), np.empty((0, 0, 0)), ENTRIES[name].traits)


@pytest.mark.parametrize(
    ("found", "left", "before", "after", "said"),
    [
        # Multiples of the noise of the rows of joint 1.
        ([], 0.0, 1.0, 1.0, "clean"),
        ([], 1.0, 4.0, 4.0, "unexplained"),
        (["cogging"], 0.0, 20.0, 1.0, "named"),
        (["cogging"], 0.2, 9.0, 4.0, "unexplained"),
        # The right effect leaves hardly more than noise; one that is near it leaves a share that noise is not.
        (["cogging"], 0.005, 20.0, 1.6, "named"),
        (["cogging"], 0.005, 200.0, 14.0, "unexplained"),
        # No law is exact, and that of dry friction least.
        (["cogging"], 1e-6, 14_000.0, 14.0, "named"),
        (["cogging"], 5e-4, 600.0, 14.0, "unexplained"),
        (["coulomb_friction"], 5e-4, 600.0, 14.0, "named"),
    ],
)
def test_the_verdict_follows_from_what_is_left(
    found: list[str], left: float, before: float, after: float, said: str
) -> None:
    rows = [{"joint_1": RowResidual(times, 1.2), "base": RowResidual(1.0, 1.2)} for times in (before, after)]
    assert verdict(bool(found), left, rows[1], rows[0], [_found(name, "joint_1") for name in found]) == said


def test_friction_of_one_joint_excuses_nothing_at_another() -> None:
    before, after = (
        {f"joint_{k}": RowResidual(times, 1.2) for k, times in enumerate(each, start=1)}
        for each in ((600.0, 600.0), (1.0, 14.0))
    )
    for where, said in (("joint_1", "unexplained"), ("joint_2", "named")):
        assert verdict(True, 5e-4, after, before, [_found("coulomb_friction", where)]) == said


@pytest.mark.parametrize(
    ("excess", "exact"),
    [
        # What is left with these links exact, of a system with two straight ones.
        ({"": 1e6, "link_1": 10.0, "link_2": 9e5, "link_1 link_2": 2e5}, "link_1"),
        ({"": 1e6, "link_1": 10.0, "link_2": 9e5, "link_1 link_2": 5.0}, "link_1"),
        ({"": 1e6, "link_1": 5e4, "link_2": 9e5, "link_1 link_2": 5.0}, "link_1 link_2"),
        ({"": 1e6, "link_1": 9.5e5, "link_2": 1.2e6, "link_1 link_2": 9.9e5}, None),
        # Chance, where straight links leave little or nothing.
        ({"": -50.0, "link_1": -46.0, "link_2": -44.0, "link_1 link_2": -47.0}, None),
        ({"": 30.0, "link_1": 26.0, "link_2": 28.0, "link_1 link_2": 25.0}, None),
        # Readings that no exact link gives.
        ({"": 1e6, "link_1": 9.5e5, "link_2": None, "link_1 link_2": None}, None),
    ],
)
def test_links_stiffen_that_take_something_away(
    monkeypatch: pytest.MonkeyPatch, excess: dict[str, float | None], exact: str | None
) -> None:
    class Attempted:
        def __init__(self, case: Any, system: System, *_: Any) -> None:
            self.tracing = SimpleNamespace(candidates=[])
            self.links = " ".join(effect.where for effect in system.effects)
            self.left = excess[self.links]
            if self.left is None:
                raise np.linalg.LinAlgError

        def excess(self, chosen: Any) -> float | None:
            return self.left

    def trial(system: System, constants: Any, beta: Any, effects: Any) -> Attempted:
        return Attempted(None, system)

    monkeypatch.setattr(exact_links, "Attempt", Attempted)
    rows = SimpleNamespace(beta=np.zeros(1))
    attempt: Any = SimpleNamespace(system=load_system("paper-planar"), rows=rows, constants=(), trial=trial)
    case: Any = None
    found: Any = exact_links.with_exact_links(case, attempt, [])
    assert (None if found is None else found.links) == exact


def test_what_leaves_more_of_held_out_torques_predicts_worse() -> None:
    before = {"joint_1": 0.2, "joint_2": 0.5}
    assert predicts_worse(before, {"joint_1": 0.2, "joint_2": 0.8})
    assert not predicts_worse(before, {"joint_1": 0.3, "joint_2": 0.2})
    # Torques of noise differ by less than a tenth, and rows without a torque have no share.
    assert not predicts_worse(before, {"joint_1": 0.2, "joint_2": 0.52})
    assert not predicts_worse({}, {})


@pytest.mark.parametrize("noise", [1e-5, 1e-4])
def test_an_axis_is_at_rest_where_its_rate_is_noise_for_long(noise: float) -> None:
    """A position that reverses at 0.25 and 0.75 s, rests from 1 to 1.6 s, sticks for 0.1 s at 2.5 s and goes back."""
    t = np.arange(3000) / 1000.0
    rest = ((t >= 1.0) & (t < 1.6)) | ((t >= 2.5) & (t < 2.6))
    rate = np.where(t < 1.0, np.cos(2.0 * np.pi * t), np.where(rest, 0.0, np.where(t < 2.5, 1.0, -1.0)))
    position = np.cumsum(rate)[:, None] / 1000.0 + noise * np.random.default_rng(5).standard_normal((t.size, 1))
    layout = SimpleNamespace(theta_m=(0,), offset=0)
    sensing: Any = SimpleNamespace(model=SimpleNamespace(layout=layout), coordinates=lambda values: values)
    held = SessionStandstill(sensing, [Segment(np.arange(t.size), position)], 0, noise, 1000.0)
    rested = smooth(position, np.arange(1150, 1550, 4), 28, 1000.0)[1]
    assert slowest(noise, rate_filter(1000.0), 1000.0) == pytest.approx(4.0 * rested.std(), rel=0.35)
    seen = np.arange(100, 2900)
    still = held.at(0, seen)
    edges = t[seen[np.flatnonzero(np.diff(still, prepend=False, append=False)[: still.size])]]
    assert edges == pytest.approx([1.0, 1.6, 2.5, 2.6], abs=0.03)
    # It moves off forwards, then back.
    leaving = held.leaving(0, seen)
    assert leaving[(seen > edges[1] * 1000.0 - 20) & still & (seen < 2000)] == pytest.approx(1.0)
    assert leaving[(seen > edges[3] * 1000.0 - 20) & still & (seen > 2000)] == pytest.approx(-1.0)
    assert np.sum(np.abs(leaving)) == 50
    assert not np.any(leaving[~still])


def test_an_axis_turns_back_where_its_rate_changes_its_sign() -> None:
    """From 1 to −0.2 rad/s² at 0.5 s, as friction does it, and not where the rate only comes near to zero."""
    t = np.arange(1500) / 1000.0
    rate = np.where(t < 0.5, 0.5 - t, 0.2 * (0.5 - t)) * np.where(t < 1.0, 1.0, np.abs(t - 1.2) + 0.3)
    position = np.cumsum(rate)[:, None] / 1000.0
    axis = Standstill(1, 1000.0)
    axis.push(position, np.array([1e-9]))
    found = np.flatnonzero(axis.turning(np.arange(100, 1400))[:, 0]) + 100
    assert found.size == 2
    assert t[found] == pytest.approx([0.5, 0.501], abs=0.004)


@pytest.mark.parametrize("noise", [1e-6, 1e-5, 1e-4])
def test_the_integral_of_a_sign_is_as_uncertain_as_stated(noise: float) -> None:
    """A rate that falls by 6 rad/s² to zero and by 2 beyond, as of a motor that dry friction has slowed down."""
    random = np.random.default_rng(8)
    layout = SimpleNamespace(theta_m=(0,), offset=0)
    sensing: Any = SimpleNamespace(model=SimpleNamespace(layout=layout), coordinates=lambda values: values)
    t = np.arange(400) / 1000.0
    turns = random.uniform(0.19, 0.21, 60)
    angles = [np.where(t < turn, -3.0, -1.0) * (t - turn) ** 2 for turn in turns]
    segments = [Segment(np.arange(t.size), (a + noise * random.standard_normal(t.size))[:, None]) for a in angles]
    reversals = Reversals(sensing, segments, noise, 1000.0, SessionStandstill(sensing, segments, 0, noise, 1000.0))
    samples = np.arange(100, 300)
    off, predicted = [], []
    for k, turn in enumerate(turns):
        nothing = np.zeros((samples.size, 1))
        motion = SeenMotion(k, 80, samples, nothing, nothing, nothing)
        sign = reversals.mean(lambda v: np.tanh(v / 1e-4)[..., None], motion)[:, 0, 0]
        # Cells of half a sample beyond both ends.
        true = (turn - t[100] + 0.5e-3) - (t[299] + 0.5e-3 - turn)
        off.append(sign.sum() / 1000.0 - true)
        predicted.append(np.sqrt(reversals.squares(lambda v: np.tanh(v / 1e-4), motion).sum()) / 1000.0)
    share = np.sqrt(np.mean(np.square(off))) / np.sqrt(np.mean(np.square(predicted)))
    assert 0.4 < share < 1.5


@pytest.mark.parametrize(("worse", "kept"), [(1.05, [0]), (1.3, [0, 1])])
def test_what_nothing_supports_is_no_finding(worse: float, kept: list[int]) -> None:
    """Friction that the axis has, and a constant torque that it has not: held-out torques may need it all the same."""
    block = axis_block(nothing, seconds=4.0)
    described = declaring(SYSTEM, [Effect(name="torque_offset", where="joint_1")])
    session = session_of(described, [block])
    named = {p.name: p for p in session.base.parameters if "@" in p.name}
    candidates = [SimpleNamespace(parameters=(each,)) for each in named.values()]
    tracing = SimpleNamespace(
        candidates=candidates,
        least_improvement=lambda k: 0.1,
        improvement=lambda chosen, k: SimpleNamespace(share=0.05),
    )

    def state(chosen: list[int]) -> Any:
        left = 0.02 if 1 in chosen else 0.02 * worse
        return SimpleNamespace(holdout=SimpleNamespace(relative={"joint_1": left}))

    attempt: Any = SimpleNamespace(tracing=tracing, state=state)
    assert list(named) == ["viscous_friction@joint_1.damping", "torque_offset@joint_1.torque"]
    assert supported(attempt, [0, 1], session) == kept
