"""What a session leaves of its joints' torques: with what it has found its encoders to be off by."""

from __future__ import annotations

import numpy as np
import pytest

from sms_online.evaluation import Evaluation
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.snapshot import statistics_of
from sms_online.stream import Block
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
