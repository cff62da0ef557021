"""Jitter of a device's stamps: estimated from its samples, counted in the rows, named in the verdict."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.stamp_jitter import Jitter, JitterState, jitters, left_and_rates, noise_beside, pair_sums
from sms_online.stream import Array, Block
from tests.evaluated import evaluated
from tests.slow_encoder import GEAR, I_L, I_M, B, F, K, bench, session

RATE, NOISE = 1000.0, 1e-4
DEVICES = [("encoders", [0, 1]), ("markers", [2, 3])]


def samples(random: np.random.Generator, jitter: float, wobble: float = 0.0) -> tuple[Array, Array]:
    """Instants and readings (4000, 4) of two devices; stamps of the first jitter by so much, s.

    wobble: of all channels together, at random.
    """
    t = np.arange(4000) / RATE
    late = jitter * random.standard_normal((t.size, 1)) * [1.0, 1.0, 0.0, 0.0]
    at = t[:, None] - late
    size, frequency, phase = np.array([0.4, 0.3, 0.05, 0.02]), np.array([0.7, 1.1, 0.9, 1.3]), np.arange(4.0)
    exact = size * np.sin(2.0 * np.pi * frequency * at + phase)
    noise = NOISE * random.standard_normal(exact.shape) + wobble * random.standard_normal((t.size, 1))
    return t, exact + noise


def found(t: Array, values: Array) -> tuple[Jitter, ...]:
    return found_of(t, values, np.zeros(4, dtype=bool), DEVICES)


def found_of(
    t: Array, values: Array, quaternion: NDArray[np.bool_], devices: list[tuple[str, list[int]]]
) -> tuple[Jitter, ...]:
    sensors = values.shape[1]
    sums = pair_sums(*left_and_rates(values, t), quaternion)
    state = JitterState.none(sensors).with_sums(*sums, np.arange(sensors))
    return jitters(state, devices, np.full(sensors, 1.0 / RATE))


def test_noise_of_a_unit_quaternion_is_no_jitter() -> None:
    """Its parts have noise in common, for a camera's angles are noisy and not they."""
    for seed in range(5):
        random = np.random.default_rng(seed)
        t = np.arange(4000)[:, None] / RATE
        turned = Rotation.from_rotvec([0.6, 0.5, 0.8] * np.sin([0.8, 1.1, 0.7] * t + [0.0, 1.0, 2.0]))
        seen = turned * Rotation.from_rotvec(3e-4 * random.standard_normal((t.size, 3)))
        place = 0.03 * np.sin([0.2, 0.3, 0.4] * t) + 1e-4 * random.standard_normal((t.size, 3))
        values = np.concatenate((place, seen.as_quat(canonical=True)), axis=1)
        device = [("camera", list(range(7)))]
        assert found_of(t[:, 0], values, np.zeros(7, dtype=bool), device)
        assert not found_of(t[:, 0], values, np.arange(7) >= 3, device)


@pytest.mark.parametrize("size", [1e-4, 5e-4])
def test_the_jitter_of_a_device_is_estimated(size: float) -> None:
    """Of 4000 samples within 5 %, which is three of its scatter."""
    for seed in range(5):
        (jitter,) = found(*samples(np.random.default_rng(seed), size))
        assert (jitter.name, jitter.sensors) == ("encoders", (0, 1))
        assert jitter.std == pytest.approx(size, rel=0.05)
        assert jitter.density == pytest.approx(jitter.std**2 / RATE)


def test_noise_beside_a_jitter_is_estimated() -> None:
    t, values = samples(np.random.default_rng(0), 5e-4)
    left, rates = left_and_rates(values, t)
    # At rest alone the jitter does not hide it: a quarter of 4000 samples.
    assert noise_beside(left[:, 0], rates[:, 0], 5e-4) == pytest.approx(NOISE, rel=0.2)


def test_a_channel_at_rest_has_no_noise_beside_a_jitter() -> None:
    """An encoder whose last digit does not move."""
    assert noise_beside(np.zeros(50), np.zeros(50), 1e-4) < 1e-100


@pytest.mark.parametrize("wobble", [0.0, 1e-4])
def test_noise_is_no_jitter(wobble: float) -> None:
    """Neither that of each channel nor that of all of them."""
    for seed in range(20):
        assert found(*samples(np.random.default_rng(seed), 0.0, wobble=wobble)) == ()


def test_an_arm_at_rest_shows_no_jitter() -> None:
    t = np.arange(4000) / RATE
    values = NOISE * np.random.default_rng(0).standard_normal((t.size, 4))
    assert found(t, values) == ()


def test_a_constant_channel_shows_no_jitter() -> None:
    t, values = samples(np.random.default_rng(0), 0.0)
    values[:, 1] = 0.3
    values[:, 2] = 0.0
    with np.errstate(all="raise", under="ignore"):
        assert found(t, values) == ()


def test_devices_of_one_clock_have_one_jitter() -> None:
    t, values = samples(np.random.default_rng(1), 3e-4)
    sums = pair_sums(*left_and_rates(values, t), np.zeros(4, dtype=bool))
    state = JitterState.none(4).with_sums(*sums, np.arange(4))
    (jitter,) = jitters(state, [("motors", [0]), ("links", [1]), ("markers", [2, 3])], np.full(4, 1.0 / RATE))
    assert (jitter.name, jitter.sensors) == ("motors and links", (0, 1))


def jittering(size: float, seed: int) -> Block:
    """The bench's session with both encoders read at random by so much, s, before or after their stamps."""
    block, random = session(None, seed=seed), np.random.default_rng(500 + seed)
    values = block.values.copy()
    at = block.t + size * random.standard_normal(block.t.size)
    clean = make_interp_spline(block.t[::10], block.values[::10, 1:], 5)
    values[:, 1:] += clean(at) - clean(block.t)
    return Block(block.t, block.channels, values)


@pytest.mark.long
def test_bars_hold_beside_stamps_that_jitter() -> None:
    """Ten seeds of five parameters; jitter makes 20 times the encoders' noise. Chance has 44 to 50 of 50 hold."""
    true, held = np.array([I_M / GEAR**2, I_L, K, B, F]), []
    for seed in range(10):
        block = jittering(5e-4, seed)
        estimator = Estimator(bench(), block.channels, "bench")
        estimator.push(block)
        estimator.finish()
        now = evaluated(estimator)
        held.append(np.abs(now.estimate.pi - true) < 1.96 * now.std)
        assert now.trust.level == "doubt"
        assert not now.trust.grave, now.trust.reasons
        said = re.search(r"^stamps of link encoders and encoders jitter by (0\.\d+) ms$", now.trust.reasons[0])
        assert said is not None
        assert float(said[1]) == pytest.approx(0.5, rel=0.1)
    assert np.sum(held) >= 44, np.mean(held, axis=0)
