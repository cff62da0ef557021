"""Blocks of time that are held out in turn, and what they say of a fall of the residual."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_online.diagnosis.evidence import least_squares, least_squares_without
from sms_online.diagnosis.folds import ALWAYS, BLOCKS, Folds, fall
from sms_online.pipeline.momentum_windows import HOPS


def folds(count: int, parts: int = 1) -> Folds:
    return Folds.of(np.arange(count) * parts // count, np.arange(count, dtype=float))


def test_every_window_is_held_out_once() -> None:
    some = folds(200)
    assert some.count == BLOCKS
    assert np.all(sum(some.held(k).astype(int) for k in range(some.count)) == 1)


def test_what_is_fitted_shares_no_sample_with_its_block() -> None:
    some = folds(200)
    held, fitted = np.flatnonzero(some.held(4)), np.flatnonzero(some.fitted(4))
    assert np.abs(held[:, None] - fitted).min() == HOPS
    # Windows of another segment share none.
    two = folds(200, parts=2)
    edge = np.flatnonzero(two.held(5))[0]
    assert two.fitted(5)[edge - 1]


def test_windows_without_the_effect_are_always_fitted() -> None:
    tested = np.arange(200) >= 120
    some = Folds.of(np.zeros(200, dtype=np.int64), np.arange(200, dtype=float), tested)
    assert np.all(some.block[:120] == ALWAYS)
    assert all(some.fitted(k)[:100].all() for k in range(some.count))


def test_other_windows_belong_to_the_nearest_block() -> None:
    some = folds(100)
    np.testing.assert_array_equal(some.of_others(np.zeros(3, dtype=np.int64), np.array([0.2, 55.0, 99.4])), [0, 5, 9])


def test_a_fall_in_a_single_block_is_uncertain() -> None:
    before = np.full(10, 4.0)
    everywhere = fall(before, np.full(10, 1.0))
    assert everywhere.share == pytest.approx(0.5)
    assert everywhere.certain
    single = fall(before + 100.0 * (np.arange(10) == 3), np.full(10, 4.0))
    assert single.share > 0.3
    assert not single.certain


def test_a_rise_is_one_beyond_what_a_coefficient_costs() -> None:
    before = np.full(10, 1.0)
    assert fall(before, np.full(10, 1.5)).rises
    assert not fall(before, np.full(10, 1.01)).rises


@pytest.mark.parametrize("dependent", [False, True])
def test_parts_of_one_factorisation_solve_without_a_block(dependent: bool) -> None:
    """Also where a column is nothing without a block, or two are the same (seed 8)."""
    rng = np.random.default_rng(8)
    columns, b = rng.standard_normal((200, 6)), rng.standard_normal(200)
    left_out = np.arange(200) // 40 == np.arange(5)[:, None]
    if dependent:
        columns[:, 5] = columns[:, 4]
    columns[~left_out[2], 3] = 0.0
    expected = [least_squares(columns[~each], b[~each]) for each in left_out]
    assert_allclose(
        least_squares_without(columns, b, list(left_out), np.zeros(6, dtype=bool)), expected, rtol=1e-9, atol=1e-12
    )
