"""Error bars of a smoother from blocks of spans."""

from __future__ import annotations

import numpy as np
import pytest

from sms_online.smoother.jackknife import FEWEST_BLOCKS, MOST_BLOCKS, SpanBlock, jackknife_covariance, with_span
from sms_online.stream import Array
from sms_online.trackers.factor import triangular_factor

NOTHING = np.empty((0, 3))
ROWS = 20


def blocks_of(shared: float, count: int, rng: np.random.Generator) -> tuple[SpanBlock, ...]:
    """Blocks of rows with unit errors and, in each block, one error of a size that all its rows share."""
    blocks: tuple[SpanBlock, ...] = ()
    for k in range(count):
        Y = np.ones((ROWS * (1 + k % 2), 1)) + 0.1 * rng.standard_normal((ROWS * (1 + k % 2), 1))
        Y = np.column_stack((Y, rng.standard_normal(len(Y))))
        b = rng.standard_normal(len(Y)) + shared * rng.standard_normal()
        blocks = with_span(blocks, len(Y), triangular_factor(np.column_stack((Y, b))))
    return blocks


def mean_covariance(shared: float) -> tuple[Array, Array]:
    """The jackknife's, mean of 300 sessions of 12 blocks, and that of the estimates."""
    found, estimates = [], []
    for seed in range(300):
        blocks = blocks_of(shared, 12, np.random.default_rng(seed))
        covariance = jackknife_covariance(blocks, NOTHING)
        assert covariance is not None
        found.append(covariance)
        whole = triangular_factor(*(each.factor for each in blocks))
        estimates.append(np.linalg.solve(whole[:2, :2], whole[:2, 2]))
    return np.mean(found, axis=0), np.cov(np.array(estimates).T)


@pytest.mark.parametrize("shared", [0.0, 1.0])
def test_the_scatter_of_blocks_is_that_of_the_estimates(shared: float) -> None:
    """A variance from 300 sessions has a standard deviation of a twelfth; from rows alone it would be a thirtieth."""
    found, true = mean_covariance(shared)
    np.testing.assert_allclose(np.diag(found), np.diag(true), rtol=0.3)


def test_few_blocks_show_no_scatter_and_many_merge() -> None:
    rng = np.random.default_rng(0)
    assert jackknife_covariance(blocks_of(0.0, FEWEST_BLOCKS - 1, rng), NOTHING) is None
    blocks = blocks_of(0.0, 3 * MOST_BLOCKS, rng)
    assert len(blocks) == MOST_BLOCKS
    assert sum(each.rows for each in blocks) == ROWS * MOST_BLOCKS * 3 * 3 // 2


def test_what_one_block_alone_determines_has_no_scatter() -> None:
    """Then the others say nothing of it, and the usual covariance is all that there is."""
    blocks = list(blocks_of(0.0, FEWEST_BLOCKS, np.random.default_rng(1)))
    for k in range(1, FEWEST_BLOCKS):
        blocks[k].factor[:, 1] = 0.0
    covariance = jackknife_covariance(tuple(blocks), NOTHING)
    assert covariance is not None
    assert covariance[1, 1] == 0.0
    assert covariance[0, 0] > 0.0
