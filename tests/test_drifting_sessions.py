"""Sessions in which a parameter drifts: it is named, followed and trusted; a step stays a step."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import sms_online as sms
from sms_online.errors import InputError
from sms_sim.drifting import parse_drift
from sms_tools.cli import main

LEARNED = "kalman:drift=learned"
BEGIN = 8.3  # s
STIFFNESS = "joint_1.stiffness"


@pytest.fixture(scope="module")
def data() -> sms.Capture:
    drift = f"{STIFFNESS}:share=-0.04,over=20,begin={BEGIN}"
    return sms.simulate(sms.load_system("paper-planar"), duration=18.0, grade="B", drift=[drift])


@pytest.fixture(scope="module")
def followed(data: sms.Capture) -> sms.Result:
    return sms.estimate(sms.load_system("paper-planar"), data, tracker=[LEARNED, "rls"])


@pytest.mark.long
def test_a_drift_on_the_way_is_named_and_followed(followed: sms.Result) -> None:
    (drift,) = followed.drifts
    assert drift.parameter == STIFFNESS
    assert drift.since == pytest.approx(BEGIN, abs=1.0)
    assert drift.rate == pytest.approx(-2.0, abs=4.0 * drift.std)
    stiffness = followed.parameters[STIFFNESS]
    assert stiffness.true == pytest.approx(1000.0 - 2.0 * (18.0 - BEGIN))
    assert stiffness.value == pytest.approx(stiffness.true, abs=4.0 * stiffness.std)
    assert stiffness.std < 0.1
    assert followed.events == ()
    assert followed.trust.level == "trust"


@pytest.mark.long
def test_least_squares_beside_it_says_that_it_fails(followed: sms.Result) -> None:
    judged, squares = followed.trackers
    assert judged.consistency.consistent
    assert not squares.consistency.consistent
    assert squares.drifts == ()


@pytest.mark.long
def test_without_a_tracker_that_follows_nothing_is_green(data: sms.Capture) -> None:
    result = sms.estimate(sms.load_system("paper-planar"), data, tracker="rls")
    stiffness = result.parameters[STIFFNESS]
    assert stiffness.true is not None
    assert abs(stiffness.value - stiffness.true) > 4.0 * stiffness.std
    assert result.trust.level == "doubt"


@pytest.mark.long
@pytest.mark.parametrize("cut", [10.0, 14.0])
def test_a_checkpoint_while_it_drifts_gives_the_same_bits(cut: float, data: sms.Capture, followed: sms.Result) -> None:
    session = sms.Session(sms.load_system("paper-planar"), data.channels, tracker=[LEARNED, "rls"])
    whole = True
    for block in data:
        if whole and block.t[0] > cut:
            session, whole = sms.Session.restore(session.save()), False
        session.update(block)
    session.finish()
    found = session.result
    assert [(p.value, p.std) for p in found.parameters.values()] == [
        (p.value, p.std) for p in followed.parameters.values()
    ]
    assert found.drifts == followed.drifts
    assert found.trackers[1] == followed.trackers[1]


@pytest.mark.long
def test_a_step_stays_an_event() -> None:
    step = f"{STIFFNESS}:share=-0.05,over=0.001,begin=7.6"
    system = sms.load_system("paper-planar")
    result = sms.estimate(system, sms.simulate(system, duration=16.0, grade="B", drift=[step]), tracker=LEARNED)
    assert result.drifts == ()
    assert [event.kind for event in result.events] == ["stiffness"]
    assert result.events[0].time == pytest.approx(7.6, abs=0.05)


@pytest.mark.long
def test_the_command_line_says_what_drifts(
    tmp_path: Path, data: sms.Capture, followed: sms.Result, capsys: pytest.CaptureFixture[str]
) -> None:
    sms.write_capture(data, tmp_path / "run.csv")
    arguments = ["replay", str(tmp_path / "run.csv"), "--system", "paper-planar", "--out", str(tmp_path / "out")]
    assert main([*arguments, "--tracker", LEARNED, "--tracker", "rls"]) == 0
    text = capsys.readouterr().out
    assert f"drift since {followed.drifts[0].since:.1f} s: {STIFFNESS} -2" in text
    assert "trackers on the same rows" in text
    document = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))
    assert [drift["parameter"] for drift in document["trackers"][0]["drifts"]] == [STIFFNESS]
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "kalman learned" in report
    assert f"{STIFFNESS} -2" in report


@pytest.mark.parametrize(
    "text",
    [
        "joint_1.stiffness",
        "joint_1.stiffness:share=-0.1",
        "joint_1.stiffness:share=-0.1,half_life=3",
        "joint_1.stiffness:half_life=-3",
        "joint_1.stiffness:share=much,over=3",
        ":share=-0.1,over=3",
    ],
)
def test_a_text_that_is_no_drift_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="PARAMETER:share"):
        parse_drift(text)


def test_a_drift_of_what_the_system_lacks_is_refused() -> None:
    with pytest.raises(InputError, match="no such parameter"):
        sms.simulate(sms.load_system("paper-planar"), duration=1.0, drift=["joint_7.stiffness:half_life=3"])
