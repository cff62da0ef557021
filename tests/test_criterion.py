"""The criterion that is invariant to the scale of rows without a torque, on small rows and on whole sessions."""

from __future__ import annotations

import numpy as np
import pytest

import sms_online as sms
from sms_online.pipeline.criterion import Columns, minimum
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.momentum_windows import OVERLAP
from sms_online.pipeline.prior_information import Penalty, PriorInformation
from sms_online.pipeline.row_grams import RowGrams
from sms_online.stream import Array
from sms_online.trackers.interface import Prior
from tests.evaluated import judged, standard_deviation
from tests.slow_encoder import GEAR, I_L, I_M, B, F, K, bench, session


def _alone(n: int) -> tuple[Columns, PriorInformation]:
    """n parameters, none of them inertial, of which nothing is known beside the rows."""
    return Columns(0, (), np.zeros(n, dtype=np.bool_)), PriorInformation.none(n)


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
    found = minimum(grams, np.array([False, True]), TORQUE, [scale * TRUE], *_alone(2)).beta
    np.testing.assert_allclose(found, TRUE, rtol=2e-3)


def test_the_slope_vanishes_at_the_minimum_but_for_priors() -> None:
    grams = _rows(400, 1e-2, lack=0.3)
    lacking = np.array([True, True])
    free = minimum(grams, lacking, TORQUE, [TRUE], *_alone(2))
    size = np.sqrt(np.diag(free.covariance))
    assert np.all(np.abs(free.slopes.sum(axis=0) * size) < 1e-3)
    prior = np.array([[10.0, 0.0, 10.0 * 1.5]])  # 1.5 ± 0.1
    held = minimum(grams, lacking, TORQUE, [TRUE], _alone(2)[0], PriorInformation(prior, np.zeros((0, 3))))
    pull = prior[:, :-1].T @ (prior @ np.append(held.beta, -1.0))
    np.testing.assert_allclose(held.slopes.sum(axis=0) * size, -pull * size, atol=1e-3)
    assert 1.5 < held.beta[0] < free.beta[0]


def test_noise_of_rows_without_torque_shrinks_no_parameter() -> None:
    errors, squares = [], []
    for seed in range(20):
        grams = _rows(1000, 1.0, lack=0.0, seed=seed)
        whole = grams.signal.matrices.sum(axis=0)
        shrunk = np.linalg.solve(whole[:-1, :-1], whole[:-1, -1])
        squares.append(shrunk / TRUE - 1.0)
        errors.append(minimum(grams, np.array([False, False]), TORQUE, [shrunk], *_alone(2)).beta / TRUE - 1.0)
    assert np.all(np.mean(squares, axis=0) < -0.05)
    assert np.all(np.abs(np.mean(errors, axis=0)) < 0.015)


def test_a_badly_explained_torque_enlarges_no_parameter() -> None:
    random = np.random.default_rng(1)
    grams = RowGrams.none(1, 1)
    for _ in range(4000):
        x, other = random.standard_normal(2)
        rows, added = np.array([[x, 2.0 * x + 6.0 * other]]), np.array([[1e-4, 0.0]])
        grams.add(rows, np.stack((rows + added, rows - added)))
    found = minimum(
        grams,
        np.array([True]),
        np.array([True]),
        [np.array([1.0])],
        Columns(0, (), np.zeros(1, dtype=np.bool_)),
        PriorInformation.none(1),
    )
    assert found.beta[0] == pytest.approx(2.0, abs=0.3)
    assert found.covariance[0, 0] == pytest.approx(36.0 * OVERLAP / 4000.0, rel=0.1)


def test_rows_of_other_weights_count_as_those_to_come() -> None:
    """Rows that were whitened with parameters twice as large, and with a misfit 100 times as large."""
    grams, alike = RowGrams.none(2, 2), RowGrams.none(2, 2)
    random = np.random.default_rng(3)
    before, now = (2.0 * TRUE, np.array([99.0, 9.0])), (TRUE, np.array([0.0, 0.09]))
    scale = np.sqrt(1.0 + before[1]) * np.array([1.0, 2.0])  # a torque's noise does not grow with the parameters
    scale /= np.sqrt(1.0 + now[1])
    for window in range(200):
        rows = random.standard_normal((2, 3))
        added = np.array([[0.0, 0.0, 1.0], [1.0, 1.0, 0.0]]) * random.standard_normal((2, 3))
        both = np.stack((rows + added, rows - added))
        by = scale[:, None] if window < 100 else 1.0
        if window == 100:
            grams.whiten_anew(before, now)
        grams.add(rows / by, both / by)
        alike.add(rows, both)
    # Rows without an excess of now are whitened against each other: those of before, which were not, gain nothing.
    for found, expected in ((grams.signal, alike.signal), (grams.noise, alike.noise)):
        np.testing.assert_allclose(found.matrices[1], expected.matrices[1], rtol=1e-9)
        assert found.matrices[0, -1, -1] < 0.6 * expected.matrices[0, -1, -1]


def test_a_nuisance_beyond_its_tolerance_shrinks_no_parameter() -> None:
    """Rows u (π_2 + ν π_2) = 0 of a nuisance ν of 100 tolerances, whose column was evaluated with the true π."""
    random = np.random.default_rng(0)
    offset, tolerance = 0.05, 5e-4
    grams = RowGrams.none(2, 2, 1)
    for _ in range(1000):
        x, y, u, v = random.standard_normal(4)
        exact = np.array([[0.0, x, y, TRUE @ (x, y)], [3.0 * v, u, -u * TRUE[0] / TRUE[1] - offset * v, 0.0]])
        added = 1e-4 * random.standard_normal((2, 4)) * np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 1.0, 1.0, 0.0]])
        grams.add(exact + added, np.stack((exact + 2.0 * added, exact)))
    columns = Columns(1, (), np.zeros(3, dtype=np.bool_))
    known = PriorInformation(np.zeros((0, 4)), np.array([[1.0 / tolerance, 0.0, 0.0, 0.0]]))
    found = minimum(grams, np.array([False, True]), TORQUE, [np.array([0.0, *TRUE])], columns, known)
    np.testing.assert_allclose(found.beta, [offset, *TRUE], rtol=2e-3)


def test_the_slope_of_the_penalty_is_its_difference() -> None:
    known = PriorInformation(np.array([[0.0, 3.0, 0.0, 1.0]]), np.array([[20.0, 0.0, 0.0, 0.0]]))
    penalty = Penalty(known, 1, np.array([[1.0, 2.0, 3.0, 1.0]]), np.array([0.0, 1.0, 2.0, -1.0]))
    for w in (np.array([0.01, 1.1, 1.8, -1.0]), np.array([3.0, 0.5, 2.5, -1.0])):
        slope = penalty.derivatives(w)[0]
        moved = [1e-6 * np.eye(4)[k] for k in range(3)]
        expected = [(penalty.value(w + by) - penalty.value(w - by)) / 2e-6 for by in moved]
        np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=1e-6)


def _identified(
    corner: float | None, coulomb: float, factor: float, prior: bool = False, once: float = 0.0
) -> tuple[Estimator, Array]:
    block = session(corner, coulomb, once)
    estimator = Estimator(bench(factor), block.channels, "bench")
    if prior:
        nominal = estimator.base.values(estimator.model.nominal)
        estimator.set_prior(Prior(nominal, np.where(nominal == 0.0, np.nan, 0.1 * nominal)))
    estimator.push(block)
    estimator.finish()
    true = np.array([I_M / GEAR**2, I_L, K, B, F])
    return estimator, estimator.estimate().pi / true - 1.0


@pytest.mark.long
@pytest.mark.parametrize(("corner", "once"), [(200.0, 0.0), (100.0, 0.0), (40.0, 0.0), (None, 0.02)])
def test_a_wrong_link_encoder_does_not_collapse_the_spring(corner: float | None, once: float) -> None:
    found = [_identified(corner, 0.0, factor, once=once) for factor in (0.5, 2.0)]
    for estimator, error in found:
        assert np.all(np.abs(error[:3]) < 0.02)
        assert judged(estimator).grave
        assert estimator.by_momentum
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-3)


@pytest.mark.long
def test_friction_beside_a_slow_encoder_costs_four_percent() -> None:
    for factor in (0.5, 2.0):
        estimator, error = _identified(40.0, 0.01, factor)
        assert np.all(np.abs(error[:3]) < 0.04)
        assert judged(estimator).grave
        # Its bars allow for what it is off by.
        std = standard_deviation(estimator)[:3] / np.array([I_M / GEAR**2, I_L, K])
        assert np.all(np.abs(error[:3]) < 3.0 * std)


@pytest.mark.slow
@pytest.mark.parametrize(("corner", "once"), [(40.0, 0.0), (None, 0.02)])
def test_priors_do_not_bend_what_a_wrong_encoder_leaves(corner: float | None, once: float) -> None:
    estimator, error = _identified(corner, 0.0, 1.0, prior=True, once=once)
    assert np.all(np.abs(error[:3]) < 0.02)
    assert judged(estimator).level == "doubt"


@pytest.mark.slow
def test_a_prior_that_is_wrong_is_said_to_be() -> None:
    estimator, _ = _identified(None, 0.0, 2.0, prior=True)
    assert any("off its prior" in reason for reason in judged(estimator).reasons)


@pytest.mark.long
def test_one_torque_with_friction_fixes_the_scale() -> None:
    """Where the gain of the other is wrong too: its rows, which say 1e10 times as much, then hold no scale."""
    lacking = [
        "coulomb_friction@joint_1:torque=12",
        "stribeck_friction@joint_2:torque=6",
        "torque_gain@joint_2:ratio=.1",
    ]
    data = sms.simulate("paper-planar", duration=10.0, grade="B", effects=lacking)
    result = sms.estimate("paper-planar", data)
    share = result.residuals["joint_1"].relative
    assert share is not None
    assert share < 0.05
    nominal = result.parameters["joint_1.stiffness"].nominal
    assert nominal is not None
    assert result.parameters["joint_1.stiffness"].value == pytest.approx(nominal, rel=0.1)
