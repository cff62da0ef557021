"""At rest dry friction is any force up to breakaway: no parameters predict it, and validation leaves it out."""

from __future__ import annotations

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.parse import parse_system
from tests.two_axes import RATE, TEXT

MOVING, RESTING = 6.0, 4.0  # s


def run(resting: float) -> sms.Capture:
    """A run that goes on, behind a gap, at rest: held by forces that the law of friction does not give."""
    system = parse_system(TEXT, "test")
    moving = sms.simulate(system, MOVING, seed=2)
    count, encoders = round(resting * RATE), [moving.channels.index(name) for name in ("q_1", "q_2")]
    rest = np.tile(moving.values[-1], (count, 1))
    rest[:, encoders] += 5e-6 * np.random.default_rng(0).standard_normal((count, 2))
    rest[:, [moving.channels.index(name) for name in ("tau_1", "tau_2")]] = 0.5, -0.3
    t = np.concatenate((moving.t, moving.t[-1] + 2.0 + np.arange(count) / RATE))
    values = np.concatenate((moving.values, rest))
    return sms.Capture.from_arrays(t, dict(zip(moving.channels, values.T, strict=True)))


@pytest.mark.slow
def test_rest_is_left_out_and_said() -> None:
    system = parse_system(TEXT, "test")
    moving, both = (sms.validate(system, run(resting)) for resting in (0.0, RESTING))
    assert moving.verdict == both.verdict == "hold"
    assert not any("at rest" in each for each in moving.warnings)
    assert any("at rest" in each for each in both.warnings)
    for name, torque in both.joints.items():
        assert torque.at_rest == pytest.approx(RESTING / (MOVING + RESTING), abs=0.02)
        assert torque.left == pytest.approx(moving.joints[name].left, rel=0.05)
