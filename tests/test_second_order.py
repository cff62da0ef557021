"""Second-order noise of rows: that of an axis which turns back is none of the rows in which it moves."""

from __future__ import annotations

import numpy as np

from sms_online.pipeline.second_order import RowErrors, SecondOrderNoise
from sms_online.pipeline.smoothing import HALF_WIDTHS

M = HALF_WIDTHS[2]


def test_friction_that_turns_back_is_no_noise_of_moving_rows() -> None:
    """One window in five holds a reversal of the first axis, with a sample a hundred times as large."""
    rng = np.random.default_rng(1)
    resting = np.zeros((500, 2), dtype=np.bool_)
    resting[::5, 0] = True
    samples = rng.standard_normal((500, 2)) * np.where(resting, 100.0, 1.0)
    moving, whole = RowErrors(2).push([M] * 500, samples, resting, np.zeros((500, 2)))
    np.testing.assert_allclose(moving[200:].mean(axis=0), 1.0, rtol=0.2)
    np.testing.assert_allclose(whole[200:].mean(axis=0), [0.2 * 1e4, 1.0], rtol=0.3)
    of_capture = SecondOrderNoise.of(samples, ~resting, np.full(500, M)).variance(M)
    np.testing.assert_allclose(of_capture, 1.0, rtol=0.2)


def test_an_axis_that_never_moves_has_no_such_noise() -> None:
    resting = np.ones((50, 1), dtype=np.bool_)
    moving, _ = RowErrors(1).push([M] * 50, np.ones((50, 1)), resting, np.zeros((50, 1)))
    assert np.all(moving < 1e-12)
