"""All encoders of a rigid arm come late behind its torques, with friction that the description lacks beside it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

import sms_online as sms
from sms_online.description.parse import parse_system
from sms_online.effects.build import declaring
from sms_online.effects.catalogue import parse_effect
from sms_online.stream import Block
from tests.two_axes import DURATION, TEXT

LATE = 0.006  # s


@pytest.mark.slow
@pytest.mark.parametrize("late", [0.0, LATE])
def test_a_latency_of_all_encoders_is_named(late: float) -> None:
    system = parse_system(TEXT, "test")
    lacking = declaring(system, [parse_effect("stribeck_friction@joint_1:torque=2,velocity=0.1", system)])
    capture = sms.simulate(lacking, DURATION, seed=1)
    values = capture.values.copy()
    encoders = [capture.channels.index(name) for name in ("q_1", "q_2")]
    values[:, encoders] = make_interp_spline(capture.t, values[:, encoders], 3)(capture.t - late)
    found = sms.diagnose(system, [Block(capture.t, capture.channels, values)])
    lags = [effect for effect in found.system.effects if effect.name == "sensor_lag"]
    assert [effect.where for effect in lags] == (["q_*"] if late else [])
    assert "stribeck_friction@joint_1" in [effect.key for effect in found.system.effects]
    for effect in lags:
        delay = np.sqrt(2.0) / (2.0 * np.pi * effect.coefficients["corner"])
        assert delay == pytest.approx(late, rel=0.1)
