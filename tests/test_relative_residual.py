"""What a session leaves of its joints' torques: with what it has found its encoders to be off by."""

from __future__ import annotations

import numpy as np
import pytest

import sms_online as sms
from sms_online.evaluation import Evaluation
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.snapshot import statistics_of
from sms_online.stream import Block
from tests.axis_effects import SYSTEM, axis_block
from tests.slow_encoder import bench, session


@pytest.mark.slow
def test_a_zero_that_a_session_finds_leaves_no_torque() -> None:
    """A link encoder's zero 50 mrad off is 0.065 N m through the spring, 40 % of the torque."""
    block = session(None)
    some = slice(0, 3000)
    values = block.values[some] + np.array([0.0, 0.0, 0.05])
    estimator = Estimator(bench(), block.channels, "test")
    estimator.push(Block(block.t[some], block.channels, values))
    estimator.finish()
    found = Evaluation(statistics_of(estimator), estimator.estimate())
    assert {each.name for each in found.calibration if each.certain} == {"encoder_zero"}
    left = found.residuals["joint_1"].relative
    assert left is not None
    assert left < 0.02
    described = estimator.energy.joint_residuals[0].relative(found.estimate.pi)
    assert described is not None
    assert described > 0.3


def test_a_share_behind_an_event_is_of_samples_behind_it() -> None:
    """Friction from 8 s on: samples of before are still on their way to this balance when the event is decided on."""
    session = sms.Session(SYSTEM, ("force_1", "q_1"))
    session.update(axis_block(lambda q, rate: 0.3 * np.sign(rate), 8.0))
    session.finish()
    assert [event.kind for event in session.result.events] == ["friction"]
    # 0.01 N m of noise of some 1.9 N m.
    relative = session.result.residuals["joint_1"].relative
    assert relative is not None
    assert relative < 0.01
