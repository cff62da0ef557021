"""Encoders of one joint that do not turn alike, as `check` and a running session say it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.sources import LogSignal, TableSource

SYSTEM = "paper-planar"  # springs that give way by a quarter of the motion
GEAR = 50.0


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def capture() -> sms.Capture:
    return sms.simulate(SYSTEM, duration=3.0, grade="B", seed=1)


def scaled(capture: sms.Capture, channel: str, factor: float) -> sms.Capture:
    values = capture.values.copy()
    values[:, capture.channels.index(channel)] *= factor
    return replace(capture, values=values)


@pytest.mark.parametrize(
    ("channel", "factor", "said"),
    [
        ("q_1", np.rad2deg(1.0), "it is in degrees"),
        ("theta_m_1", np.rad2deg(1.0), "it is in degrees"),
        ("theta_m_2", GEAR, "the motor's angle before the gear"),
        ("theta_m_1", 6.0, "one of them is in another unit"),
        ("theta_m_2", -1.0, "one of them has the wrong sign"),
        ("q_1", -1000.0, "one of them is in another unit, and one of them has the wrong sign"),
    ],
)
def test_encoders_that_do_not_turn_alike_are_named(
    capture: sms.Capture, channel: str, factor: float, said: str
) -> None:
    found = sms.check(SYSTEM, scaled(capture, channel, factor))
    assert not found.passed
    grave = [remark for remark in found.remarks if remark.grave and "turns" in remark.text]
    assert len(grave) == 1
    assert said in grave[0].text
    assert {grave[0].channel, grave[0].text.split(" as far as ")[1].split(",")[0].split(":")[0]} == {
        f"q_{channel[-1]}",
        f"theta_m_{channel[-1]}",
    }


def test_encoders_on_either_side_of_a_soft_spring_are_alike(capture: sms.Capture) -> None:
    found = sms.check(SYSTEM, capture)
    assert found.passed
    assert not [remark for remark in found.remarks if "turns" in remark.text]


def test_a_gear_ratio_that_no_spring_explains_is_named(capture: sms.Capture) -> None:
    stiff = sms.load_system(SYSTEM)
    joints = (stiff.joints[0].model_copy(update={"stiffness": 1e6}), *stiff.joints[1:])
    q = capture.values[:, capture.channels.index("q_1")]
    values = capture.values.copy()
    values[:, capture.channels.index("theta_m_1")] = 1.25 * q
    found = sms.check(stiff.model_copy(update={"joints": joints}), replace(capture, values=values))
    assert not found.passed
    (remark,) = (remark for remark in found.remarks if "turns" in remark.text)
    assert remark.channel == "theta_m_1"
    assert "a gear ratio of 62.5 in place of 50, or a far softer spring" in remark.text


def test_a_log_that_is_divided_by_another_gear_is_named(capture: sms.Capture) -> None:
    system = sms.load_system(SYSTEM)
    signals = {
        "shaft": LogSignal(channel="theta_m_1", gear=40.0),
        "torque": LogSignal(channel="tau_1", gear=GEAR),
        "angle": LogSignal(channel="theta_m_2", gear=GEAR),
        "link": LogSignal(channel="q_2", gear=3.0),
    }
    log = TableSource(kind="table", name="drives", signals=signals)
    found = sms.check(system.model_copy(update={"sources": (log,)}), capture)
    (remark,) = (remark for remark in found.remarks if "divided by" in remark.text)
    assert remark.grave
    assert str(remark.text) == "divided by a gear of 40, where joint_1 has a gear ratio of 50"
