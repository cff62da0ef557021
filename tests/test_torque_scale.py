"""Gains of torques: a ratio of two is ambiguous, a common one is that of all parameters unless one of these is known.

Sessions of the planar example of 8 s, noise of grade B (seed 4), nominal values off by up to 1.4 (seed 2); torques are
read 3 % too large, three tolerances.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.schema import System
from sms_online.diagnosed import Diagnosis
from tests.campaigns.sessions import disguised

GAIN = 1.03
KNOWN = "link_2.mass_per_length"
pytestmark = pytest.mark.long


@cache
def simulated() -> sms.Capture:
    return sms.simulate("paper-planar", duration=8.0, grade="B", seed=4)


def read_too_large(*joints: int) -> sms.Capture:
    capture = simulated()
    columns = {name: column.copy() for name, column in zip(capture.channels, capture.values.T, strict=True)}
    for joint in joints:
        columns[f"tau_{joint}"] *= GAIN
    return sms.Capture.from_arrays(capture.t, columns)


def described() -> System:
    return disguised(sms.load_system("paper-planar"), np.random.default_rng(2))


@cache
def of_joint_1() -> Diagnosis:
    return sms.diagnose(described(), read_too_large(1))


def test_a_gain_of_one_joint_is_a_ratio_that_may_be_either_s() -> None:
    found = of_joint_1()
    (effect,) = found.document()["effects"]
    assert (effect["name"], effect["where"]) == ("torque_gain", "joint_2")
    assert effect["ambiguous_with"][0] == "torque_gain@joint_1"
    assert effect["sentence"] == (
        "joint_2's torque reads 3 % low against joint_1's: the data cannot decide which is right"
    )
    assert "joint_2 or joint_1" in found.summary


def test_parameters_with_an_ambiguous_gain_are_not_trusted() -> None:
    found = of_joint_1()
    again = sms.estimate(found.search.after.system, read_too_large(1))
    for trust in (found.trust, again.trust):
        assert trust.level == "doubt"
        assert "the data cannot decide which is right" in trust.sentence
        assert "weigh one part" in trust.next_step
        assert not any("trust the parameters" in reason for reason in trust.reasons)


def test_a_common_gain_is_the_scale_that_results_rest_on() -> None:
    found = sms.diagnose(described(), read_too_large(1, 2))
    assert (found.verdict, found.effects) == ("clean", ())
    clean = sms.diagnose(described(), simulated())
    assert found.trust.level == clean.trust.level
    result = sms.estimate(described(), read_too_large(1, 2))
    assert "the common scale of all parameters rests on the torque constants, ± 1 %" in result.trust.reasons
    assert result.document()["scale_tolerance"] == 0.01


def test_a_weighed_part_shows_a_common_gain() -> None:
    true = sms.load_system("paper-planar").nominal
    system = described().model_copy(update={"known": {KNOWN: true[KNOWN]}})
    assert system.scale_tolerance is None
    found = sms.diagnose(system, read_too_large(1, 2))
    assert found.effects == ()
    gains = [each for each in sms.estimate(system, read_too_large(1, 2)).calibration if each.name == "drive_gain"]
    assert [each.where for each in gains] == ["joint_1", "joint_2"]
    for each in gains:
        assert abs(each.estimate - (1.0 - 1.0 / GAIN)) < 3.0 * each.std < 0.1 * each.estimate
