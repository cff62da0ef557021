"""A drift that nobody follows is never green, and steady sessions stay so."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

import sms_online as sms
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.tracker_bank import Suspected
from sms_online.row_types import Residual
from sms_online.session import with_trackers
from sms_online.tracker_results import Consistency
from sms_online.verdict.evidence import Evidence
from sms_online.verdict.judge import judge
from sms_online.verdict.reasons import DIAGNOSE, DIAGNOSED, FOLLOW, GO_ON
from tests.axis import AXIS, MOTION
from tests.bus_streams import axis_testbed

DRIFT = "link_1.inertia:share=-0.2,over=20,begin=8.3"
GOOD = Evidence(determined=(2, 2), residual={"joint_1": Residual(0.01, 1.0)})


@cache
def axis_capture(seed: int, *drift: str) -> tuple[sms.System, sms.Capture]:
    """The axis as simulated at grade B."""
    system = sms.load_system(tomllib.loads(AXIS + MOTION))
    return system, sms.simulate(system, 19.0, "B", seed, drift=drift)


def judged(tracker: str, seed: int, drift: Sequence[str] = ()) -> sms.Trust:
    system, capture = axis_capture(seed, *drift)
    return sms.estimate(system, capture, tracker=tracker).trust


@pytest.mark.slow
@pytest.mark.parametrize(("tracker", "then"), [("rls", FOLLOW), ("kalman:drift=learned", GO_ON)])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_drift_that_nobody_follows_is_doubted(tracker: str, then: str, seed: int) -> None:
    """Seeds 0 and 1 show the least of it among eight."""
    trust = judged(tracker, seed, [DRIFT])
    assert (trust.level, trust.grave) == ("doubt", False)
    assert trust.grounds[0].text.startswith("link_1.inertia seems to move since")
    assert trust.grounds[0].then == then


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 3, 9, 15])
def test_steady_sessions_are_trusted(seed: int) -> None:
    """Seed 9 has the loudest rows of sixteen, seed 15 the ramp that is least like chance on the way."""
    assert judged("rls", seed).level == "trust"


def test_rows_louder_than_the_error_bars_are_not_trusted() -> None:
    """Rows that are quieter make the bars too large, which harms nobody: samples may be better than stated."""
    for nis in (0.6, 1.0):
        assert judge(replace(GOOD, consistency=Consistency(nis, 0.8, 1.2))).level == "trust"
    trust = judge(replace(GOOD, consistency=Consistency(1.4, 0.8, 1.2)))
    assert (trust.level, trust.grave) == ("doubt", False)
    assert "1.2 × their noise (NIS 1.40, beyond 1.20)" in trust.sentence
    assert trust.grounds[0].then == DIAGNOSE
    # A diagnosis is no next step where one has described the system.
    diagnosed = judge(replace(GOOD, consistency=Consistency(1.4, 0.8, 1.2), diagnosed=True))
    assert diagnosed.reasons == trust.reasons
    assert diagnosed.next_step == DIAGNOSED


@pytest.mark.parametrize(("seconds", "level"), [(0.0, "trust"), (59.0, "trust"), (61.0, "doubt")])
def test_a_long_session_that_nobody_watches_is_doubted(seconds: float, level: str) -> None:
    trust = judge(replace(GOOD, unwatched=seconds))
    assert (trust.level, trust.grave) == (level, False)
    if level == "doubt":
        assert trust.grounds[0].then == FOLLOW


def test_drifts_are_not_looked_for_beside_wandering_clocks(tmp_path: Path) -> None:
    """Unless a tracker is chosen that follows them; from one clock they are, as far as there are rows for it."""
    devices, one = axis_testbed(tmp_path), sms.load_system(tomllib.loads(AXIS))
    energies = one.model_copy(update={"balance": "energy"})
    sessions = [
        Estimator(system, ("force_1", "q_1"), "test")
        for system in (devices, with_trackers(devices, "kalman:drift=learned"), one, with_trackers(one, "rls"))
    ]
    assert [each.momentum.bank.unwatched for each in sessions if each.momentum] == [True, False, False, False]
    labels = [each.trackers[0].label for each in (*sessions, Estimator(energies, ("force_1", "q_1"), "test"))]
    assert labels == ["rls", "kalman learned", "kalman learned", "rls", "rls"]


def test_what_is_missing_comes_before_a_suspected_drift() -> None:
    """A lack of the model bends parameters in time, and is said in place of that."""
    trust = judge(replace(GOOD, suspected=Suspected(("link_1.inertia",), 8.0, False), alarm="joint_1"))
    assert trust.grave
    assert not any("seems to move" in reason.text for reason in trust.grounds)
