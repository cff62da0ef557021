"""Noise estimates, the choice of the smoothing window, and rates from positions."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_online.pipeline.noise import noise_std
from sms_online.pipeline.rates import (
    HALF_WIDTHS,
    RateSamples,
    RatesStage,
    choose_half_width,
    coefficients,
    smooth_and_differentiate,
)
from sms_online.pipeline.synchronise import GridSamples
from sms_online.stream import Array

RATE = 1000.0
UNSTATED = np.full(3, np.nan)


def motion(count: int, frequency: float = 5.0) -> tuple[Array, Array]:
    """Positions and rates (count, 3) of 0.3 rad at about one frequency, Hz."""
    phase = 2 * np.pi * frequency * np.array([0.6, 0.8, 1.0]) * (np.arange(count) / RATE)[:, None]
    rate = 2 * np.pi * frequency * np.array([0.6, 0.8, 1.0])
    return 0.3 * np.sin(phase + 1.0), 0.3 * rate * np.cos(phase + 1.0)


def noise(count: int, sigma: float, seed: int, channels: int = 3) -> Array:
    return sigma * np.random.default_rng(seed).standard_normal((count, channels))


def run(stage: RatesStage, values: Array, cuts: Iterable[int] = (), segment: int = 0) -> list[RateSamples]:
    pieces = []
    bounds = [0, *cuts, values.shape[0]]
    for a, b in pairwise(bounds):
        if b > a:
            pieces += stage.push(GridSamples(np.arange(a, b), values[a:b], segment))
    return pieces + stage.flush()


def joined(pieces: list[RateSamples]) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.int64]]:
    """Index, values, rates and half width of every delivered sample."""
    return (
        np.concatenate([p.index for p in pieces]),
        np.concatenate([p.values for p in pieces]),
        np.concatenate([p.rates for p in pieces]),
        np.concatenate([np.full(p.index.size, p.half_width) for p in pieces]),
    )


def noise_gain(half_width: int, sample_rate: float) -> tuple[float, float]:
    """1σ of value and of rate (1/s) that white noise of 1σ = 1 per sample leaves behind the filter: ‖h_0‖, ‖h_1‖."""
    value, slope = coefficients(half_width)
    value_gain = 1.0 if half_width == HALF_WIDTHS[0] else float(np.linalg.norm(value))
    return value_gain, float(np.linalg.norm(slope)) * sample_rate


# --- noise


@pytest.mark.parametrize("sigma", [1e-6, 1e-4, 1e-2])
def test_white_noise_is_found_under_motion_up_to_30_hz(sigma: float) -> None:
    t = np.arange(2000) / RATE
    values = np.sin(2 * np.pi * np.outer(t, np.linspace(0.5, 30.0, 60))) + noise(2000, sigma, 1, 60)
    estimate = noise_std(values) / sigma
    assert np.median(estimate) == pytest.approx(1.0, abs=0.02)
    # Scatter of one channel 3.5 %, four of which no channel of sixty exceeds.
    assert estimate.std() < 0.05
    assert np.abs(estimate - 1.0).max() < 0.15


@pytest.mark.parametrize("sigma", [1e-6, 1e-4, 1e-2])
def test_white_noise_is_found_at_unequal_steps(sigma: float) -> None:
    """Steps of half to one and a half milliseconds and a gap of ten seconds."""
    steps = np.random.default_rng(4).uniform(0.5, 1.5, 2000) / RATE
    steps[700] = 10.0
    t = np.cumsum(steps)
    values = np.sin(2 * np.pi * np.outer(t, np.linspace(0.5, 10.0, 60))) + noise(2000, sigma, 1, 60)
    estimate = noise_std(values, t) / sigma
    assert np.median(estimate) == pytest.approx(1.0, abs=0.02)
    assert np.abs(estimate - 1.0).max() < 0.15


def test_without_noise_the_estimate_is_rounding() -> None:
    t = np.arange(1000) / RATE
    assert noise_std(np.sin(2 * np.pi * np.outer(t, np.linspace(0.5, 30.0, 20)))).max() < 1e-14


@pytest.mark.parametrize("quantum", [2 * np.pi / 4096, 1e-4, 5e-8])
@pytest.mark.parametrize(("frequency", "most"), [(0.1, 2.0), (3.0, 1.25)])
def test_an_encoder_has_at_least_the_noise_of_its_grid(quantum: float, frequency: float, most: float) -> None:
    """Slow motion too, where most samples repeat the one before and the median of differences is a coarse measure."""
    positions = quantum * np.rint(motion(1000, frequency)[0] / quantum)
    ratio = noise_std(positions) / (quantum / np.sqrt(12.0))
    assert ratio.min() > 0.95
    assert ratio.max() < most


def test_a_constant_channel_has_no_noise() -> None:
    values = noise(2000, 1e-3, 2)
    values[:, 0] = 4.2
    values[::100, 1] += 1.0
    estimate = noise_std(values)
    assert estimate[0] == 0.0
    assert 0.9e-3 < estimate[1] < 1.5e-3


def test_too_few_samples_for_a_noise_estimate_are_refused() -> None:
    with pytest.raises(ValueError, match="too few"):
        noise_std(np.zeros((17, 1)))


# --- filter


@pytest.mark.parametrize("half_width", HALF_WIDTHS)
def test_polynomials_of_degree_eight_are_exact(half_width: int) -> None:
    t = np.linspace(-1.0, 1.0, 201)
    polynomial = np.polynomial.Polynomial(np.random.default_rng(3).standard_normal(9))
    values, rates = smooth_and_differentiate(polynomial(t)[:, None], half_width, 100.0)
    inner = t[half_width : t.size - half_width]
    np.testing.assert_allclose(values[:, 0], polynomial(inner), atol=1e-13)
    np.testing.assert_allclose(rates[:, 0], polynomial.deriv()(inner), atol=1e-11)


def test_the_narrowest_window_is_a_central_difference() -> None:
    stencil = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0.0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
    np.testing.assert_allclose(coefficients(4)[1], stencil, atol=1e-14)
    values = noise(100, 1.0, 4)
    assert np.array_equal(smooth_and_differentiate(values, 4, RATE)[0], values[4:-4])


def test_rates_of_motion_up_to_30_hz_are_good_to_1e_8() -> None:
    values, rates = motion(5000, 30.0)
    _, found = smooth_and_differentiate(values, 4, RATE)
    assert np.std(found - rates[4:-4]) < 1e-8 * np.std(rates)


@pytest.mark.parametrize("half_width", HALF_WIDTHS)
def test_white_noise_passes_with_the_stated_gain(half_width: int) -> None:
    values, rates = smooth_and_differentiate(noise(200_000, 2.0, 5, 1), half_width, RATE)
    value_gain, rate_gain = noise_gain(half_width, RATE)
    # Neighbours are correlated over about M / 2 samples: four standard deviations are 2 to 3 %.
    assert values.std() == pytest.approx(2.0 * value_gain, rel=0.03)
    assert rates.std() == pytest.approx(2.0 * rate_gain, rel=0.03)


# --- choice of the window


@pytest.mark.parametrize("frequency", [0.2, 5.0, 30.0])
def test_without_noise_the_window_is_the_narrowest(frequency: float) -> None:
    positions = motion(1000, frequency)[0]
    assert choose_half_width(positions, noise_std(positions)) == HALF_WIDTHS[0]


def test_noise_widens_the_window_as_far_as_the_motion_allows() -> None:
    def chosen(sigma: float, frequency: float) -> int:
        positions = motion(1000, frequency)[0] + noise(1000, sigma, 6)
        return choose_half_width(positions, noise_std(positions))

    assert chosen(1e-4, 5.0) == 28
    assert chosen(1e-4, 30.0) in (6, 9)
    widths = [chosen(sigma, 15.0) for sigma in (1e-9, 1e-7, 1e-5, 1e-3)]
    assert widths == sorted(widths)
    assert widths[0] < widths[-1]


@pytest.mark.parametrize("frequency", [5.0, 12.0, 20.0, 30.0, 45.0])
def test_the_error_of_smoothing_stays_below_the_noise(frequency: float) -> None:
    sigma = 1e-4
    positions, rates = motion(1000, frequency)
    noisy = positions + noise(1000, sigma, 7)
    half_width = choose_half_width(noisy, noise_std(noisy))
    _, smoothed = smooth_and_differentiate(positions, half_width, RATE)
    error = np.sqrt(np.mean((smoothed - rates[half_width:-half_width]) ** 2, axis=0))
    assert error.max() < 0.2 * sigma * noise_gain(half_width, RATE)[1]


# --- stage


def test_every_sample_but_the_borders_comes_out_with_its_rate() -> None:
    positions, rates = motion(4000)
    stage = RatesStage(RATE, (0, 1, 2), UNSTATED)
    index, values, found, half_width = joined(run(stage, positions, range(100, 4000, 100)))
    assert np.array_equal(index, np.arange(4, 3996))
    assert set(half_width) == {4}
    assert np.array_equal(values, positions[4:-4])
    np.testing.assert_allclose(found, rates[4:-4], atol=1e-8)
    assert stage.fixed


def noisy_capture() -> Array:
    """1.5 s at rest, then motion; the last column a torque whose noise must not decide."""
    positions = motion(5000, 8.0)[0]
    positions[:1500] = positions[1500]
    values = positions + noise(5000, 1e-4, 8)
    values[:, 2] *= 1e3
    return values


def test_a_start_at_rest_does_not_fix_the_window() -> None:
    stage = RatesStage(RATE, (0, 1), UNSTATED)
    index, _, _, half_width = joined(run(stage, noisy_capture()))
    assert np.array_equal(np.diff(index), np.ones(index.size - 1))
    assert index[0] == half_width[0]
    assert index[-1] == 4999 - half_width[-1]
    assert half_width[index < 1000].min() == half_width[index < 1000].max() >= 19  # rest
    assert np.unique(half_width[index >= 2000]).size == 1  # fixed by the first window that moves throughout
    assert stage.fixed
    np.testing.assert_allclose(stage.sigma[:2], 1e-4, rtol=0.15)


def test_stated_noise_is_used_instead_of_an_estimate() -> None:
    stated = np.array([1e-4, 1e-4, np.nan])
    stage = RatesStage(RATE, (0, 1), stated)
    run(stage, noisy_capture())
    assert np.array_equal(stage.sigma[:2], stated[:2])
    assert stage.sigma[2] == pytest.approx(0.1, rel=0.15)


def test_blocks_do_not_change_a_bit() -> None:
    values = noisy_capture()
    reference = joined(run(RatesStage(RATE, (0, 1), UNSTATED), values))
    rng = np.random.default_rng(9)
    for cuts in (range(1, 5000), np.sort(rng.integers(0, 5000, 30)).tolist(), range(1000, 5000, 1000)):
        found = joined(run(RatesStage(RATE, (0, 1), UNSTATED), values, cuts))
        assert all(np.array_equal(a, b) for a, b in zip(found, reference, strict=True))


def test_each_segment_loses_only_its_borders() -> None:
    positions, rates = motion(6000)
    stage = RatesStage(RATE, (0, 1, 2), UNSTATED)
    pieces = []
    for segment, (a, b) in enumerate([(0, 500), (600, 3000), (3100, 3105), (3200, 6000)]):
        pieces += stage.push(GridSamples(np.arange(a, b), positions[a:b], segment))
    pieces += stage.flush()
    index, _, found, _ = joined(pieces)
    assert np.array_equal(index, np.r_[4:496, 604:2996, 3204:5996])
    np.testing.assert_allclose(found, rates[index], atol=1e-8)
    assert [p.segment for p in pieces] == sorted(p.segment for p in pieces)
    assert {p.segment for p in pieces} == {0, 1, 3}
