"""Values and rates of the momentum balance: exact for polynomials, deaf to what thinning folds back, wide enough."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from sms_online.pipeline.smoothing import DEGREE, HALF_WIDTHS, WidthChoice, kernel, smooth, smooth_all, stride
from sms_online.stream import Array

RATE = 1000.0
# Of values and rates of size one in units of the half width; the widest kernels' fits are the least well conditioned.
ROUNDING = 1e-10
half_widths = pytest.mark.parametrize("half_width", HALF_WIDTHS)


@half_widths
def test_polynomials_up_to_degree_eight_are_exact(half_width: int) -> None:
    """In z = t / M, so that every power is one at the end of the window."""
    samples = np.arange(4 * half_width + 1)
    z = (samples - 2 * half_width) / half_width
    polynomials = [Polynomial.basis(degree) for degree in range(DEGREE + 1)]
    values = np.stack([p(z) for p in polynomials], axis=1)
    centres = np.arange(half_width, 3 * half_width + 1)
    found, rates = smooth(values, centres, half_width, RATE)
    np.testing.assert_allclose(found, values[centres], rtol=0.0, atol=ROUNDING)
    exact = np.stack([p.deriv()(z[centres]) for p in polynomials], axis=1) * RATE / half_width
    np.testing.assert_allclose(rates, exact, rtol=0.0, atol=ROUNDING * RATE)


def test_the_narrowest_kernel_is_a_central_difference() -> None:
    side = np.array([4.0 / 5.0, -1.0 / 5.0, 4.0 / 105.0, -1.0 / 280.0])
    np.testing.assert_allclose(kernel(4)[:, 1], np.concatenate((-side[::-1], [0.0], side)), rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(kernel(4)[:, 0], np.eye(9)[4], rtol=0.0, atol=1e-14)


@half_widths
def test_kernels_have_no_phase(half_width: int) -> None:
    value, slope = kernel(half_width).T
    np.testing.assert_array_equal(value, value[::-1])
    np.testing.assert_array_equal(slope, -slope[::-1])


@half_widths
def test_all_centres_at_once_are_the_same_up_to_rounding(half_width: int) -> None:
    """Noise of unit size, seed 3."""
    samples = np.random.default_rng(3).standard_normal((5 * half_width, 2))
    centres = np.arange(half_width, len(samples) - half_width)
    one_by_one, at_once = smooth(samples, centres, half_width, RATE), smooth_all(samples, half_width, RATE)
    for each, together in zip(one_by_one, at_once, strict=True):
        np.testing.assert_allclose(together, each, rtol=0.0, atol=1e-12 * np.abs(each).max())


def response(half_width: int, frequency: Array) -> Array:
    """Gains (F, 2) of value and slope, each over its largest, at frequencies (F,) in cycles a sample."""
    k = np.arange(-half_width, half_width + 1)
    gain = np.abs(np.exp(-2j * np.pi * frequency[:, None] * k) @ kernel(half_width))
    passed = np.abs(np.exp(-2j * np.pi * np.linspace(0.0, 0.5, 1001)[:, None] * k) @ kernel(half_width))
    return np.asarray(gain / passed.max(axis=0))


@half_widths
def test_thinning_aliases_less_than_1e_4(half_width: int) -> None:
    """What lies at a multiple of the thinned rate and looks like a constant then; for hops of 5 to 100 samples."""
    for s in {stride(half_width, hop) for hop in range(5, 101)} - {1}:
        assert response(half_width, np.arange(1, s // 2 + 1) / s).max() < 1e-4


@half_widths
def test_thinning_keeps_whole_hops_and_seven_samples(half_width: int) -> None:
    for hop in range(1, 101):
        s = stride(half_width, hop)
        assert hop % s == 0
        assert s == 1 or 7 * s <= half_width


def test_differences_of_widths_are_in_units_of_noise() -> None:
    """Mean squares of unit white noise are one; 2000 independent windows, so 3 standard errors are 10 %. Seed 1."""
    reach = HALF_WIDTHS[-1]
    noise = np.random.default_rng(1).standard_normal((2 * reach + 1, 2000))
    squares = WidthChoice(HALF_WIDTHS).squares(noise, np.array([reach]))
    np.testing.assert_allclose(squares.mean(axis=1), 1.0, rtol=0.1)


def chosen(signal: Array, sigma: float) -> int:
    """Half width for a signal (B,) with white noise; seed 2."""
    reach = HALF_WIDTHS[-1]
    samples = (signal + sigma * np.random.default_rng(2).standard_normal(signal.size))[:, None]
    centres = np.arange(reach, signal.size - reach, 8)
    choice = WidthChoice(HALF_WIDTHS)
    return choice.widest(choice.squares(samples, centres) / centres.size, np.array([sigma]))


@pytest.mark.parametrize("sigma", [1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("frequency", [0.5, 5.0, 30.0, 80.0])
def test_the_chosen_width_loses_less_than_the_next_ones_noise(frequency: float, sigma: float) -> None:
    """That neighbour agreed, as far as its noise can show; the one after would have lost twenty times as much."""
    t = np.arange(560) / RATE
    signal = np.sin(2.0 * np.pi * frequency * t)
    half_width = chosen(signal, sigma)
    centres = np.arange(HALF_WIDTHS[-1], t.size - HALF_WIDTHS[-1])
    _, rates = smooth(signal[:, None], centres, half_width, RATE)
    lost = rates[:, 0] - 2.0 * np.pi * frequency * np.cos(2.0 * np.pi * frequency * t[centres])
    narrower = HALF_WIDTHS[max(0, HALF_WIDTHS.index(half_width) - 1)]
    assert np.sqrt(np.mean(lost**2)) < sigma * np.linalg.norm(kernel(narrower)[:, 1]) * RATE


def test_jolts_get_narrower_filters_than_calm_motion() -> None:
    t = np.arange(560) / RATE
    calm = np.sin(3.0 * t)
    jolt = calm + 0.01 * np.exp(-(((t - 0.28) / 0.004) ** 2))
    assert chosen(calm, 1e-4) == HALF_WIDTHS[-1]
    assert chosen(jolt, 1e-4) < HALF_WIDTHS[-1] / 5
