"""Noise in the columns attenuates least squares by a known factor; adding more of it shows by how much."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_online.pipeline.errors_in_variables import NoiseBias
from sms_online.stream import Array

TRUE = 2.0
ROWS = 50_000
# In the rows' b alone.
RESIDUAL = 0.1


def scalar_problem(sigma: float, seed: int) -> tuple[Array, Array]:
    """Rows [x b] (ROWS, 2) of b = 2 x, x of unit variance and known to σ; and the same with noise ± (2, ROWS, 2)."""
    rng = np.random.default_rng(seed)
    exact = rng.standard_normal(ROWS)
    measured = exact + sigma * rng.standard_normal(ROWS)
    b = TRUE * exact + RESIDUAL * rng.standard_normal(ROWS)
    added = sigma * rng.standard_normal(ROWS)
    rows = np.stack((measured, b), axis=1)
    return rows, np.stack([np.stack((measured + sign * added, b), axis=1) for sign in (1.0, -1.0)])


WINDOWS = 2500


def gathered(rows: Array, noisy: Array) -> NoiseBias:
    """Rows in windows of 20, as a session gives them."""
    bias = NoiseBias.none(rows.shape[1] - 1)
    for window in np.array_split(np.arange(len(rows)), WINDOWS):
        bias.add(rows[window], noisy[:, window])
    return bias


def least_squares(rows: Array) -> Array:
    return np.asarray(np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0])


@pytest.mark.parametrize("sigma", [0.1, 0.3, 0.5])
def test_the_shift_undoes_a_known_attenuation(sigma: float) -> None:
    """Least squares gives β / (1 + σ²). Standard errors of both: sqrt(σ² β² + s²) / sqrt(ROWS), some 5e-3. Seed 1."""
    rows, noisy = scalar_problem(sigma, seed=1)
    found = least_squares(rows)[0]
    error = np.hypot(sigma * TRUE, RESIDUAL) / np.sqrt(ROWS)
    attenuated = TRUE / (1.0 + sigma**2)
    assert abs(found - attenuated) < 4.0 * error
    assert TRUE - attenuated > 3.9 * error
    bias = gathered(rows, noisy)
    # The added noise scatters as much again as the noise that is there.
    assert abs(found + bias.correction(np.array([True])).shift[0] - TRUE) < 8.0 * error


@pytest.mark.parametrize("sigma", [1.5, 5.0])
def test_what_noise_hides_is_not_determined(sigma: float) -> None:
    """Noise makes most of the column: its correction would be anything, and counts as a deviation. Seed 3."""
    rows, noisy = scalar_problem(sigma, seed=3)
    found = least_squares(rows)[0]
    _, shift, _, covariance = gathered(rows, noisy).correction(np.array([True]))
    std = np.sqrt(covariance[0, 0])
    assert shift[0] == 0.0
    assert found < 3.0 * std
    assert abs(found - TRUE) < 2.0 * std


def test_what_noise_hides_leaves_other_directions_corrected() -> None:
    """The sum of two parameters is seen through noise of 0.3, their difference through 5. Seed 4."""
    (sum_rows, sum_noisy), (rows, noisy) = scalar_problem(0.3, seed=4), scalar_problem(5.0, seed=5)
    turn = np.array([[1.0, 1.0], [1.0, -1.0]])

    def joined(first: Array, second: Array) -> Array:
        """Rows of both, [Y b], of parameters whose sum and difference are 2 each: 2 and 0."""
        every = np.concatenate((np.outer(first[:, 0], turn[0]), np.outer(second[:, 0], turn[1])))
        return np.column_stack((every, np.concatenate((first[:, 1], second[:, 1]))))

    every = joined(sum_rows, rows)
    both = np.stack([joined(*each) for each in zip(sum_noisy, noisy, strict=True)])
    mixed = np.random.default_rng(6).permutation(len(every))
    _, shift, _, covariance = gathered(every[mixed], both[:, mixed]).correction(np.array([True, True]))
    found = least_squares(every) + shift
    assert abs(turn[0] @ found - 2.0) < 0.02
    assert np.sqrt(turn[0] @ covariance @ turn[0]) < 0.02
    assert abs(turn[1] @ found - 2.0) < 2.0 * np.sqrt(turn[1] @ covariance @ turn[1])


@pytest.mark.parametrize("sigma", [0.1, 0.3])
def test_the_covariance_is_that_of_the_second_order(sigma: float) -> None:
    """Noise u in the column adds -β u² to the score: 2 β² σ⁴ a row, and as much again from the shift. Seed 8.

    125 clusters give a variance to 13 %.
    """
    bias = gathered(*scalar_problem(sigma, seed=8))
    variance = 2.0 * TRUE**2 * sigma**4 / ROWS / (1.0 + sigma**2) ** 2
    np.testing.assert_allclose(bias.correction(np.array([True])).uncertain, 2.0 * variance, rtol=0.4)


def test_squares_of_a_noisy_speed_are_freed_in_second_order() -> None:
    """The column x² of a noisy x: what is left of the pull is of the fourth order in σ. Seed 2.

    Least squares gives β (⟨x⁴⟩ + σ² ⟨x²⟩) / (⟨x⁴⟩ + 6 σ² ⟨x²⟩ + 3 σ⁴); ⟨x²⟩ = 7/3 and ⟨x⁴⟩ = 31/5 for x in 1 … 2.
    """
    sigma = 0.1
    rng = np.random.default_rng(2)
    exact = rng.uniform(1.0, 2.0, ROWS)
    measured, added = exact + sigma * rng.standard_normal(ROWS), sigma * rng.standard_normal(ROWS)
    b = TRUE * exact**2
    rows = np.stack((measured**2, b), axis=1)
    noisy = np.stack([np.stack(((measured + sign * added) ** 2, b), axis=1) for sign in (1.0, -1.0)])
    bias = gathered(rows, noisy)
    before = least_squares(rows)[0] - TRUE
    after = before + bias.correction(np.array([True])).shift[0]
    square, fourth = sigma**2 * 7.0 / 3.0, 31.0 / 5.0
    pull = TRUE * ((fourth + square) / (fourth + 6.0 * square + 3.0 * sigma**4) - 1.0)
    np.testing.assert_allclose(before, pull, rtol=0.1)
    assert abs(after) < 0.1 * abs(before)


def test_rows_without_noise_in_their_columns_are_left_alone() -> None:
    rows, _ = scalar_problem(0.0, seed=3)
    bias = NoiseBias.none(1)
    bias.add(rows, np.stack((rows, rows)))
    assert bias.correction(np.array([True])).shift[0] == 0.0


def test_an_undetermined_parameter_shifts_no_other() -> None:
    rows, noisy = scalar_problem(0.3, seed=4)
    empty = np.zeros(ROWS)
    wide = np.stack([np.insert(each, 1, empty, axis=1) for each in noisy])
    alone, beside = gathered(rows, noisy), gathered(np.insert(rows, 1, empty, axis=1), wide)
    shift = beside.correction(np.array([True, False])).shift
    np.testing.assert_allclose(shift[0], alone.correction(np.array([True])).shift[0], rtol=1e-12)
    assert shift[1] == 0.0


def test_a_shift_that_one_window_makes_is_taken_for_chance() -> None:
    rows, _ = scalar_problem(0.0, seed=6)
    noisy = np.stack((rows, rows))
    noisy[:, :20, 0] *= 2.0
    assert gathered(rows, noisy).correction(np.array([True])).shift[0] == 0.0


def test_a_bias_that_is_not_corrected_is_within_the_bar() -> None:
    """Two clusters of 400 rows make all of it: too few to call it a bias, and it may be one."""
    rows, _ = scalar_problem(0.0, seed=6)
    noisy = np.stack((rows, rows))
    noisy[:, :800, 0] *= 2.0
    _, shift, _, covariance = gathered(rows, noisy).correction(np.array([True]))
    gram = rows.T @ rows
    free = 2.0 * gram - noisy[0].T @ noisy[0]
    assert shift[0] == 0.0
    assert np.sqrt(covariance[0, 0]) > abs(free[0, 1] / free[0, 0] - gram[0, 1] / gram[0, 0])


def test_few_parameters_more_leave_the_shift_of_the_others() -> None:
    rows, noisy = scalar_problem(0.3, seed=7)
    bias = gathered(rows, noisy)
    before = bias.correction(np.array([True])).shift[0]
    bias.widen(2)
    after = bias.correction(np.array([True, False, False])).shift
    assert after.tolist() == [before, 0.0, 0.0]


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_parameters_that_rows_know_together_are_shifted_together(seed: int) -> None:
    """Attenuation of the first of [2 1/2 1/2] bends the sum of the others, which each alone are hardly known."""
    rng = np.random.default_rng(seed)
    x, apart, tiny = rng.standard_normal((3, 5000))
    exact = np.stack((x, x + 0.3 * apart, x + 0.3 * apart + 0.003 * tiny), axis=1)
    b = exact @ [2.0, 0.5, 0.5] + RESIDUAL * rng.standard_normal(5000)

    def measured(noise: Array) -> Array:
        return np.column_stack((exact + noise.T * [0.1, 0.0, 0.001], b))

    own, added = rng.standard_normal((2, 3, 5000))
    rows = measured(own)
    found = least_squares(rows)
    bias = gathered(rows, np.stack([measured(own + added), measured(own - added)]))
    freed = found + bias.correction(np.ones(3, dtype=bool)).shift
    assert_allclose(freed[0], 2.0, atol=0.03)
    assert_allclose(freed[1:].sum(), 1.0, atol=0.03)
    left = [float(np.sum((b - rows[:, :-1] @ each) ** 2)) for each in (freed, found)]
    assert left[0] < 1.15 * left[1]
