"""The quick part of the safety net: numbers of short sessions as they were recorded. `python -m tests.net` has all."""

from __future__ import annotations

import re

import pytest

from tests.net.numbers import Numbers, differences, environment, numbers
from tests.net.recorded import Recorded, packed, unpacked
from tests.net.sessions import QUICK, SESSIONS

ESTIMATE = re.compile(r"(whole|continued)\.parameters\[.*\]\.estimate$")
# Where other libraries or another processor round differently: estimates agree to this share of their standard
# deviations, and these to this share.
ELSEWHERE = 1e-3


# Those that search for effects or add them take longer.
MARKS = {"gap": pytest.mark.long, "axis-adopted": pytest.mark.long, "axis-event": pytest.mark.long} | dict.fromkeys(
    ("axis-undescribed", "smoother", "quanser-2dsfl"), pytest.mark.slow
)


@pytest.mark.parametrize("name", [pytest.param(name, marks=MARKS.get(name, ())) for name in QUICK])
def test_no_number_of_a_session_moves(name: str) -> None:
    recorded, now = Recorded.read(), numbers(SESSIONS[name]())
    before = recorded.sessions[name]
    if recorded.environment == environment():
        assert list(differences(before, now, 0.0)) == []
    else:
        assert list(_differing_elsewhere(before, now)) == []


def _differing_elsewhere(before: Numbers, now: Numbers) -> list[str]:
    """Paths of the estimates that differ by more than rounding explains, or are not in both."""
    paths = {path for path in before.keys() | now.keys() if ESTIMATE.search(path)}
    assert paths
    return sorted(path for path in paths if path not in before or path not in now or not _close(path, before, now))


def _close(path: str, before: Numbers, now: Numbers) -> bool:
    at_std = path.removesuffix("estimate") + "std"
    std, std_now, value, value_now = before[at_std], now[at_std], before[path], now[path]
    if not isinstance(std, float) or not isinstance(std_now, float):
        return std is std_now  # undetermined: rounding alone decides on the estimate
    assert isinstance(value, float)
    assert isinstance(value_now, float)
    return max(abs(std_now - std), abs(value_now - value)) <= ELSEWHERE * std


def test_a_moved_bit_a_lost_name_and_a_new_number_are_seen() -> None:
    before: Numbers = {"a": 1.0, "b": "clean", "c": 3, "n": float("nan"), "t": True}
    after: Numbers = {"a": 1.0 + 2**-52, "b": "named", "d": None, "n": float("nan"), "t": 1}
    assert len(list(differences(before, after, 0.0))) == 5
    assert [line[0] for line in sorted(differences(before, after, 1e-12))] == ["b", "c", "d", "t"]
    assert list(differences(before, dict(before), 0.0)) == []


def test_the_file_holds_lists_together_and_nothing_twice() -> None:
    whole: Numbers = {"whole.c[0]": 0.1, "whole.c[1]": None, "whole.p[a].std": 2.0, "whole.level": "trust"}
    continued: Numbers = {path.replace("whole", "continued"): value for path, value in whole.items()}
    assert packed(whole | continued) == {"whole.c": [0.1, None], "whole.p[a].std": 2.0, "whole.level": "trust"}
    for moved in ({}, {"continued.c[1]": 0.1 + 2**-54}, {"continued.level": "doubt"}, {"continued.new": 1}):
        assert unpacked(packed(whole | continued | moved)) == whole | continued | moved


@pytest.mark.parametrize("quantity", ["estimate", "std"])
def test_elsewhere_a_hundredth_of_a_deviation_is_seen(quantity: str) -> None:
    at = "whole.parameters[joint_1.stiffness]."
    before: Numbers = {at + "estimate": 2.0, at + "std": 0.1}
    value = {"estimate": 2.0, "std": 0.1}[quantity]
    assert _differing_elsewhere(before, before | {at + quantity: value + 1e-9}) == []
    assert _differing_elsewhere(before, before | {at + quantity: value + 1e-3}) == [at + "estimate"]
    assert _differing_elsewhere(before, {}) == [at + "estimate"]
