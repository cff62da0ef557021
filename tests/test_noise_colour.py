"""The colour of a sensor's noise, estimated from its samples."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from sms_online.pipeline.noise import correlation, density_gain, noise_std


@pytest.mark.parametrize("time", [2e-3, 5e-3])
def test_the_colour_of_first_order_noise_is_estimated(time: float) -> None:
    t = np.arange(4000) * 1e-3
    a = np.exp(-1e-3 / time)
    white = np.random.default_rng(4).standard_normal(t.size)
    noise = 1e-4 * lfilter([np.sqrt(1.0 - a**2)], [1.0, -a], white)
    values = 0.3 * np.sin(2 * np.pi * 1.5 * t) + noise
    sigma = float(noise_std(values[:, None])[0])
    found = correlation(values, sigma)
    density = sigma**2 * density_gain(found, 5e-3)
    true = 1e-8 * (1.0 - a**2) / (1.0 + a**2 - 2.0 * a * np.cos(2.0 * np.pi * 5e-3))
    assert abs(density / true - 1.0) < 0.5


@pytest.mark.parametrize("time", [2e-2, 5e-2])
def test_the_density_of_slow_noise_is_estimated(time: float) -> None:
    """Beside a motion, of 4000 samples: within a factor of 3.5 in each of 20 seeds, within 1.5 in their median."""
    t, a = np.arange(4000) * 1e-3, np.exp(-1e-3 / time)
    true = 1e-8 * (1.0 - a**2) / (1.0 + a**2 - 2.0 * a * np.cos(2.0 * np.pi * 5e-3))
    shares = []
    for seed in range(20):
        white = np.random.default_rng(seed).standard_normal(2 * t.size)
        noise = 1e-4 * lfilter([np.sqrt(1.0 - a**2)], [1.0, -a], white)[t.size :]
        values = 0.03 * np.sin(2 * np.pi * 1.5 * t) + noise
        sigma = float(noise_std(values[:, None])[0])
        shares.append(sigma**2 * density_gain(correlation(values, sigma), 5e-3) / true)
    assert np.all(np.abs(np.log(shares)) < np.log(3.5)), shares
    assert abs(np.log(np.median(shares))) < np.log(1.5), shares


@pytest.mark.parametrize("frequency", [0.0, 40.0])
def test_white_noise_and_vibrations_have_no_colour(frequency: float) -> None:
    t = np.arange(4000) * 1e-3
    values = 1e-3 * np.sin(2 * np.pi * frequency * t) + 1e-4 * np.random.default_rng(6).standard_normal(t.size)
    assert correlation(values, float(noise_std(values[:, None])[0])) == 0.0
    assert density_gain(0.0, 5e-3) == pytest.approx(1.0)
