"""Sessions compared: who is marked as changed, and who is not."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import sms_online as sms
from sms_online.repeatability import FALSE_ALARM, change_text, compare_documents, judge_changes
from sms_online.stream import Array

PARAMETERS, BAR = 16, 1e-5


def scattered(seed: int, sessions: int, spread: float = BAR) -> tuple[Array, Array]:
    """Parameters of 1 that scatter by `spread` from run to run, with error bars of BAR."""
    rng = np.random.default_rng(seed)
    return 1.0 + spread * rng.standard_normal((PARAMETERS, sessions)), np.full((PARAMETERS, sessions), BAR)


@pytest.mark.parametrize("sessions", [2, 3, 4, 5, 10, 40])
@pytest.mark.parametrize("spread", [0.3 * BAR, BAR, 30.0 * BAR])
def test_alarms_are_as_rare_as_stated(sessions: int, spread: float) -> None:
    if sessions == 2 and spread > BAR:
        pytest.skip("two sessions have no spread from run to run")
    alarms = sum(bool(judge_changes(*scattered(seed, sessions, spread)).changed.any()) for seed in range(100))
    # Of 100 comparisons one is expected, more than four are beyond chance.
    assert alarms <= 400 * FALSE_ALARM


@pytest.mark.parametrize(
    ("sessions", "changed"), [(10, (2, 5, 9)), (3, (1,)), (4, (3,)), (2, (1,)), (10, (5, 6, 7, 8, 9))]
)
def test_changed_sessions_are_marked_and_no_other(sessions: int, changed: tuple[int, ...]) -> None:
    values, stds = scattered(1, sessions)
    values[3, list(changed)] *= 0.99
    assert np.argwhere(judge_changes(values, stds).changed).tolist() == [[3, i] for i in changed]


def test_what_scatters_from_run_to_run_is_no_change() -> None:
    values, stds = scattered(2, 8, spread=1e-2)
    values[0] = 1.0 + BAR * np.random.default_rng(3).standard_normal(8)
    judged = judge_changes(values, stds)
    assert not judged.changed.any()
    # The one parameter that repeats well is not excused by the others.
    values[0, 4] += 0.3
    assert np.argwhere(judge_changes(values, stds).changed).tolist() == [[0, 4]]


def test_shared_calibration_in_the_bars_hides_no_change() -> None:
    values, stds = scattered(4, 10)
    values[0, 7] += 20.0 * BAR
    # Bars a hundred times the spread: what the calibration leaves unknown is the same in every session.
    judged = judge_changes(values, 100.0 * stds)
    assert np.argwhere(judged.changed).tolist() == [[0, 7]]


def test_a_short_session_with_wide_bars_is_not_marked() -> None:
    values, stds = scattered(5, 10)
    values[2, 6], stds[2, 6] = 1.0 + 40.0 * BAR, 30.0 * BAR
    assert not judge_changes(values, stds).changed.any()


def document(name: str, stiffness: float, system: str = "rig") -> dict[str, Any]:
    numbers = {"joint_1.stiffness": stiffness, "joint_1.damping": 2.0, "link_1.inertia": math.nan}
    parameters = [
        {"name": n, "symbol": n, "unit": "", "estimate": v, "std": BAR, "identifiable": math.isfinite(v)}
        for n, v in numbers.items()
    ]
    return {"system": {"name": system}, "parameters": parameters, "calibration": []}


def test_a_comparison_says_which_session_and_by_how_much() -> None:
    documents = {f"run-{k}": document("", 1.0 + BAR * k - (0.01 if k == 2 else 0.0)) for k in range(5)}
    compared = compare_documents(documents)
    assert compared.changed == ("run-2",)
    (change,) = compared.parameters["joint_1.stiffness"].changes
    assert change.size == pytest.approx(-0.01, rel=0.01)
    assert compared.sentence == "Changed in run-2: joint_1.stiffness."
    assert "run-2 -1 %" in str(compared)
    # What no session determines has no row.
    assert [row[0] for row in compared.rows()[1]] == ["joint_1.stiffness", "joint_1.damping"]


def test_sessions_of_two_systems_are_refused() -> None:
    with pytest.raises(sms.InputError, match=r"'other'.*'rig'"):
        compare_documents({"a": document("a", 1.0), "b": document("b", 1.0, "other")})
    with pytest.raises(sms.InputError, match="two at least"):
        compare_documents({"a": document("a", 1.0)})


def test_a_number_that_may_be_zero_is_read_in_its_unit() -> None:
    documents = {f"run-{k}": document("", BAR * (-1.0) ** k) for k in range(4)}
    documents["run-4"] = document("", 0.5)
    compared = compare_documents(documents).parameters["joint_1.stiffness"]
    assert not compared.relative
    assert change_text(compared.changes[0], compared) == "+0.5"
