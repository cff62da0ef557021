"""Error bars under noise: normalised errors over many seeds, bounded from both sides."""

from __future__ import annotations

import numpy as np
import pytest

from sms_online.description.parse import parse_system
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array, Block
from tests.axis import AXIS, DAMPING, INERTIA
from tests.evaluated import standard_deviation

SEEDS = 40
SECONDS, RATE = 10.0, 200.0


def normalised_errors(torque_noise: float, position_noise: float) -> Array:
    """(SEEDS, 2): errors of inertia and damping of a moved axis over their reported standard deviations."""
    system = parse_system(AXIS, "axis.toml")
    t = np.arange(round(SECONDS * RATE)) / RATE
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    rate, acceleration = 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t), -4 * np.sin(2 * t) - 7.5 * np.sin(5 * t)
    exact = np.stack((INERTIA * acceleration + DAMPING * rate, q), axis=1)
    out = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        noise = rng.standard_normal(exact.shape) * [torque_noise, position_noise]
        estimator = Estimator(system, ("force_1", "q_1"), "axis")
        estimator.push(Block(t, ("force_1", "q_1"), exact + noise))
        estimator.finish()
        out.append((estimator.estimate().pi - [INERTIA, DAMPING]) / standard_deviation(estimator))
    return np.array(out)


@pytest.mark.long
@pytest.mark.parametrize(("torque_noise", "position_noise"), [(0.1, 0.0), (0.01, 1e-4)])
def test_error_bars_are_neither_too_small_nor_too_large(torque_noise: float, position_noise: float) -> None:
    """Torque noise is integrated into the work, position noise is in every rate: both have to be in the error bar.

    The root mean square of 40 normalised errors of deviation one lies between 0.7 and 1.35 in 99.7 %. Bars may be
    wider, since the larger of two answers is reported, but not without bound.
    """
    rms = np.sqrt(np.mean(normalised_errors(torque_noise, position_noise) ** 2, axis=0))
    assert (rms < 1.35).all(), rms
    assert (rms > 0.2).all(), rms
