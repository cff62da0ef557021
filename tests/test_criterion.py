"""The criterion that is invariant to the scale of rows without a torque, on small rows and on whole sessions."""

from __future__ import annotations

import numpy as np
import pytest
from evaluated import judged, standard_deviation
from slow_encoder import GEAR, I_L, I_M, B, F, K, bench, session

from sms_online.pipeline.criterion import OVERLAP, RowGrams, minimum
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array
from sms_online.trackers.interface import Prior

NOTHING = np.zeros((0, 3))
TORQUE = np.array([True, False])
TRUE = np.array([2.0, 3.0])


def _rows(windows: int, noise: float, lack: float, seed: int = 0) -> RowGrams:
    """Rows τ = 2 x + 3 y with noise of τ, and 2 u = 3 v with noise of u and v, over the deviations that it gives them.

    lack: of the second, a share.
    """
    random = np.random.default_rng(seed)
    grams = RowGrams.none(2, 2)
    deviation = noise * np.array([[1.0], [np.sqrt(TRUE @ TRUE)]])
    for _ in range(windows):
        x, y, u, other = random.standard_normal(4)
        exact = np.array([[x, y, TRUE @ (x, y)], [u + lack * other, -u * TRUE[0] / TRUE[1], 0.0]])
        size = noise * np.array([[0.0, 0.0, 1.0], [1.0, 1.0, 0.0]])
        rows, added = exact + size * random.standard_normal((2, 3)), size * random.standard_normal((2, 3))
        grams.add(rows / deviation, np.stack((rows + added, rows - added)) / deviation)
    return grams


@pytest.mark.parametrize("scale", [0.01, 0.5, 2.0, 100.0])
def test_every_start_meets_at_one_minimum(scale: float) -> None:
    grams = _rows(1000, 1e-3, lack=0.3)
    found = minimum(grams, np.array([False, True]), TORQUE, [scale * TRUE], NOTHING).beta
    np.testing.assert_allclose(found, TRUE, rtol=2e-3)


def test_the_slope_vanishes_at_the_minimum_but_for_priors() -> None:
    grams = _rows(400, 1e-2, lack=0.3)
    lacking = np.array([True, True])
    free = minimum(grams, lacking, TORQUE, [TRUE], NOTHING)
    size = np.sqrt(np.diag(free.covariance))
    assert np.all(np.abs(free.slopes.sum(axis=0) * size) < 1e-3)
    prior = np.array([[10.0, 0.0, 10.0 * 1.5]])  # 1.5 ± 0.1
    held = minimum(grams, lacking, TORQUE, [TRUE], prior)
    pull = prior[:, :-1].T @ (prior @ np.append(held.beta, -1.0))
    np.testing.assert_allclose(held.slopes.sum(axis=0) * size, -pull * size, atol=1e-3)
    assert 1.5 < held.beta[0] < free.beta[0]


def test_noise_of_rows_without_a_torque_does_not_shrink_the_parameters() -> None:
    errors, squares = [], []
    for seed in range(20):
        grams = _rows(1000, 1.0, lack=0.0, seed=seed)
        whole = grams.signal.sum(axis=0)
        shrunk = np.linalg.solve(whole[:-1, :-1], whole[:-1, -1])
        squares.append(shrunk / TRUE - 1.0)
        errors.append(minimum(grams, np.array([False, False]), TORQUE, [shrunk], NOTHING).beta / TRUE - 1.0)
    assert np.all(np.mean(squares, axis=0) < -0.05)
    assert np.all(np.abs(np.mean(errors, axis=0)) < 0.015)


def test_a_badly_explained_torque_does_not_enlarge_the_parameters() -> None:
    random = np.random.default_rng(1)
    grams = RowGrams.none(1, 1)
    for _ in range(4000):
        x, other = random.standard_normal(2)
        rows, added = np.array([[x, 2.0 * x + 6.0 * other]]), np.array([[1e-4, 0.0]])
        grams.add(rows, np.stack((rows + added, rows - added)))
    found = minimum(grams, np.array([True]), np.array([True]), [np.array([1.0])], np.zeros((0, 2)))
    assert found.beta[0] == pytest.approx(2.0, abs=0.3)
    assert found.covariance[0, 0] == pytest.approx(36.0 * OVERLAP / 4000.0, rel=0.1)


def _identified(corner: float | None, coulomb: float, factor: float, prior: bool = False) -> tuple[Estimator, Array]:
    block = session(corner, coulomb)
    estimator = Estimator(bench(factor), block.channels, "bench")
    if prior:
        nominal = estimator.base.values(estimator.model.nominal)
        estimator.set_prior(Prior(nominal, np.where(nominal == 0.0, np.nan, 0.1 * nominal)))
    estimator.push(block)
    estimator.finish()
    true = np.array([I_M / GEAR**2, I_L, K, B, F])
    return estimator, estimator.estimate().pi / true - 1.0


@pytest.mark.slow
@pytest.mark.parametrize("corner", [200.0, 100.0, 40.0])
def test_a_slow_link_encoder_does_not_collapse_the_spring(corner: float) -> None:
    found = [_identified(corner, 0.0, factor) for factor in (0.5, 2.0)]
    for estimator, error in found:
        assert np.all(np.abs(error[:3]) < 0.02)
        assert judged(estimator).grave
        assert estimator.by_momentum
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-3)


@pytest.mark.slow
def test_undeclared_friction_beside_a_slow_encoder_costs_four_percent() -> None:
    for factor in (0.5, 2.0):
        estimator, error = _identified(40.0, 0.01, factor)
        assert np.all(np.abs(error[:3]) < 0.04)
        assert judged(estimator).grave
        # Its bars allow for what it is off by.
        std = standard_deviation(estimator)[:3] / np.array([I_M / GEAR**2, I_L, K])
        assert np.all(np.abs(error[:3]) < 3.0 * std)


def test_a_prior_that_is_wrong_is_said_to_be() -> None:
    estimator, _ = _identified(None, 0.0, 2.0, prior=True)
    assert any("off its prior" in reason for reason in judged(estimator).reasons)
