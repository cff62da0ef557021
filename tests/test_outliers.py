"""Outliers are left out and counted, and nothing else is."""

from __future__ import annotations

import json
from itertools import pairwise

import numpy as np
import pytest

import sms_online as sms
from sms_online.pipeline.outliers import Outliers
from sms_online.stream import Array
from tests.simulations import planar_capture

RATE = 1000.0


def judged(t: Array, values: Array, block: int = 36) -> tuple[Array, Array, Outliers]:
    """What passes of some rows that come in blocks."""
    stage = Outliers(values.shape[1], range(values.shape[1]))
    bounds = [*range(0, t.size, block), t.size]
    out = [stage.push(t[a:b], values[a:b], last=b == t.size) for a, b in pairwise(bounds)]
    return np.concatenate([o[0] for o in out]), np.concatenate([o[1] for o in out]), stage


def swinging(noise: float, seed: int = 3, seconds: float = 4.0) -> tuple[Array, Array]:
    """A coordinate that swings by 0.3 rad at 2 Hz and 8 Hz, with white noise, rad."""
    t = np.arange(round(seconds * RATE)) / RATE
    swing = 0.3 * np.sin(2 * np.pi * 2.0 * t) + 0.02 * np.sin(2 * np.pi * 8.0 * t)
    return t, (swing + noise * np.random.default_rng(seed).standard_normal(t.size))[:, None]


def test_one_percent_of_outliers_is_found_and_little_else() -> None:
    t, values = swinging(1e-4)
    random = np.random.default_rng(5)
    hit = random.random(t.size) < 0.01
    hit[:30] = hit[-3:] = False
    spiked = values.copy()
    spiked[hit, 0] += 2e-3 * random.choice([-1.0, 1.0], np.count_nonzero(hit))
    _, passed, stage = judged(t, spiked)
    left_out = np.isnan(passed[:, 0])
    assert np.count_nonzero(left_out & ~hit) <= 1  # beside two in a row
    assert np.count_nonzero(left_out & hit) >= 0.95 * np.count_nonzero(hit)
    assert stage.state.left_out[0] == np.count_nonzero(left_out)


@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-3])
def test_clean_samples_pass_as_they_are(noise: float) -> None:
    t, values = swinging(noise)
    passed_t, passed, _ = judged(t, values)
    np.testing.assert_array_equal(passed_t, t)
    np.testing.assert_array_equal(passed, values)


def test_steps_shocks_and_single_counts_are_no_outliers() -> None:
    t, _ = swinging(0.0)
    random = np.random.default_rng(2)
    step = 1e-4 * random.standard_normal(t.size) + (t > 2.0)
    shock = np.where(t > 1.0, np.exp(-20.0 * (t - 1.0)) * np.sin(100.0 * (t - 1.0)), 0.0)
    counts = np.round(random.normal(0.0, 0.2, t.size))  # an encoder at rest between two counts
    values = np.column_stack((step, shock + 1e-6 * random.standard_normal(t.size), counts))
    assert not np.isnan(judged(t, values)[1]).any()


def test_slow_channels_have_their_outliers_found_too() -> None:
    t, values = swinging(1e-4)
    both = np.column_stack((values, np.where(np.arange(t.size)[:, None] % 4 == 0, values, np.nan)))
    both[2000, 1] += 5e-3
    passed = judged(t, both)[1]
    assert np.flatnonzero(np.isnan(passed[::4, 1])).tolist() == [500]


@pytest.mark.long
def test_outliers_cost_a_session_no_trust_in_its_parameters() -> None:
    system = sms.load_system("paper-planar")
    data = planar_capture(6.0, seed=1)
    column = data.channels.index("link_1.marker_2.u_y")
    values = data.values.copy()
    hit = np.arange(50, len(values), 97)
    values[hit, column] += 2e-3
    spiked = sms.Capture(data.t, data.channels, values)
    clean, result = sms.estimate(system, data), sms.estimate(system, spiked)
    assert list(result.outliers) == ["link_1.marker_2.u_y"]
    count = result.outliers["link_1.marker_2.u_y"]
    assert abs(count - hit.size) <= 0.05 * hit.size
    assert f"link_1.marker_2.u_y: {count} outliers left out" in result.warnings
    assert json.loads(result.to_json())["outliers"] == result.outliers
    assert result.trust.level == "doubt"
    assert "outliers" in result.trust.reasons[0]
    for name, parameter in result.parameters.items():
        assert abs(parameter.value - clean.parameters[name].value) < parameter.std
