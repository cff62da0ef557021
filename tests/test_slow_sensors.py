"""Sensors that are slow beside the momentum balance's windows: their rate is no loss, and the smoother follows them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.schema import Sensor, System
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.outliers import Outliers
from sms_online.stream import Block
from tests.campaigns.sessions import disguised, noisy_session, true_parameters
from tests.conftest import noise_free_block
from tests.evaluated import evaluated
from tests.sessions_of import session_of
from tests.simulations import planar

SLOW = 100  # samples of the grid to one of the base's pose: 10 Hz
BASE = ("r_S_x", "r_S_y", "theta_0")


@cache
def session(seconds: float) -> Block:
    """The planar example at grade B, its base seen ten times a second."""
    system = load_system("paper-planar")
    block = noisy_session(system, noise_free_block(planar(seconds), system), "B", 0)
    values = block.values.copy()
    gone = np.arange(block.t.size) % SLOW != 0
    for name in BASE:
        values[gone, block.channels.index(name)] = np.nan
    return replace(block, values=values)


def described(rate: float | None) -> System:
    system = disguised(load_system("paper-planar"), np.random.default_rng(0))
    others = [sensor for sensor in system.sensors if "theta_0" not in sensor.channels]
    return system.model_copy(update={"sensors": (*others, Sensor(channels=("r_S_*", "theta_0"), rate=rate))})


def estimator(rate: float | None, seconds: float) -> Estimator:
    block = session(seconds)
    return session_of(described(rate), [block])


def test_a_rate_that_nobody_stated_is_asked_for() -> None:
    trust = evaluated(estimator(None, 6.0)).trust
    slow = [ground for ground in trust.grounds if "samples/s are too few" in ground.text]
    assert [ground.text for ground in slow] == [
        "r_S_x, r_S_y and 1 more: 10 samples/s are too few for the windows of the balance"
    ]
    assert slow[0].then.startswith("state its rate")


def test_a_slow_sensor_has_lost_nothing_and_no_outliers() -> None:
    found = estimator(None, 6.0)
    assert found.outliers == {}
    assert not any("lost" in ground.text for ground in evaluated(found).trust.grounds)


@pytest.mark.slow
def test_a_stated_slow_rate_is_left_to_the_smoother() -> None:
    found = estimator(10.0, 2.0)
    assert found.momentum is None
    assert found.smoother is not None


@pytest.mark.long
def test_the_smoother_bridges_what_a_slow_sensor_does_not_see() -> None:
    found = evaluated(estimator(10.0, 20.0))
    off = (found.estimate.pi - true_parameters(load_system("paper-planar"))) / found.std
    assert np.mean(np.abs(off) < 1.96) >= 0.85
    assert np.max(np.abs(off)) < 3.5
    assert not found.trust.grave


def test_channels_slower_than_rows_can_wait_are_not_judged() -> None:
    """One jump in samples 100 ms apart; the same at 1 ms apart is an outlier."""
    rng = np.random.default_rng(1)
    values = rng.normal(0.0, 1e-5, (400, 1))
    values[200] = 1.0
    for period, left in ((0.1, False), (0.001, True)):
        outliers = Outliers(1, [0])
        passed = [outliers.push(period * np.arange(k, k + 50), values[k : k + 50])[1] for k in range(0, 400, 50)]
        passed.append(outliers.push(np.empty(0), np.empty((0, 1)), last=True)[1])
        assert bool(np.isnan(np.concatenate(passed)).any()) == left
