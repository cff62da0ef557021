"""The quick part of the safety net: numbers of short sessions as they were recorded. `python -m tests.net` has all."""

from __future__ import annotations

import json
import re

import pytest
from net import RECORDED
from net.numbers import differences, environment, numbers
from net.sessions import QUICK, SESSIONS

# Where other libraries or another processor round differently, estimates and events agree to this, relative. What is
# computed by cancellation, and which of the candidates that explain nothing are listed, does not.
ELSEWHERE = 1e-6
COMPARED_ELSEWHERE = re.compile(r"\.(parameters\[.*\]\.(estimate|std|identifiable)|events\[\d+\]\.(time|kind))$")


@pytest.mark.parametrize("name", QUICK)
def test_no_number_of_a_session_moves(name: str) -> None:
    recorded = json.loads(RECORDED.read_text())
    before, now, tolerance = recorded["sessions"][name], numbers(SESSIONS[name]()), 0.0
    if recorded["environment"] != environment():
        tolerance = ELSEWHERE
        before, now = ({k: v for k, v in each.items() if COMPARED_ELSEWHERE.search(k)} for each in (before, now))
        assert before
    assert list(differences(before, now, tolerance)) == []


def test_a_moved_bit_a_lost_name_and_a_new_number_are_seen() -> None:
    before = {"a": 1.0, "b": "clean", "c": 3, "n": float("nan"), "t": True}
    after = {"a": 1.0 + 2**-52, "b": "named", "d": None, "n": float("nan"), "t": 1}
    assert len(list(differences(before, after, 0.0))) == 5
    assert [line[0] for line in sorted(differences(before, after, 1e-12))] == ["b", "c", "d", "t"]
    assert list(differences(before, dict(before), 0.0)) == []
