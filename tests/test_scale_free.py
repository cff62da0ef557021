"""Rows without a torque that hold more than noise: a search that no scale of the parameters changes.

Rows τ = 2 x + 3 y hold a torque; rows 0 = 2 u - 3 v hold none, and what the model lacks beside them.
"""

from __future__ import annotations

import numpy as np
import pytest

from sms_online.diagnosis.scale_free import HomogeneousRows
from sms_online.stream import Array

TRUE = np.array([2.0, 3.0])
NOTHING = np.empty((400, 2, 0))


def rows(lack: float) -> tuple[Array, Array]:
    """Y (W, 2, 2) and b (W, 2); lack: share of the second rows' terms that no parameter explains."""
    random = np.random.default_rng(0)
    x, y, u, other = random.standard_normal((4, len(NOTHING)))
    first = np.stack((x, y), axis=1)
    second = np.stack((u + lack * other, -u * TRUE[0] / TRUE[1]), axis=1)
    torque = first @ TRUE + 3.0 * random.standard_normal(x.size)  # friction, say
    return np.stack((first, second), axis=1), np.stack((torque, np.zeros_like(torque)), axis=1)


def solved(Y: Array, b: Array, start: Array) -> Array:
    free = HomogeneousRows(Y, [1], np.zeros(2, dtype=bool))
    return free.solved(NOTHING, b, start, start, 1e-4, np.zeros(2, dtype=bool))


@pytest.mark.parametrize("scale", [0.2, 1.0, 5.0])
def test_parameters_do_not_shrink_where_rows_lack_something(scale: float) -> None:
    np.testing.assert_allclose(solved(*rows(lack=0.5), scale * TRUE), TRUE, rtol=0.15)


def test_least_squares_of_the_same_rows_shrinks_them() -> None:
    """Each type weighed by what it leaves, again and again."""
    Y, b = rows(lack=0.5)
    sizes = [float(np.linalg.norm(TRUE))]
    pi = TRUE
    while len(sizes) < 50 and sizes[-1] > 0.5 * sizes[0]:
        std = np.sqrt(np.mean((b - Y @ pi) ** 2, axis=0))
        pi = np.linalg.lstsq((Y / std[:, None]).reshape(-1, 2), (b / std).ravel(), rcond=None)[0]
        sizes.append(float(np.linalg.norm(pi)))
    assert sizes[-1] <= 0.5 * sizes[0]


def test_the_parameters_themselves_are_no_direction_of_freed_rows() -> None:
    Y, b = rows(lack=0.5)
    columns, added = HomogeneousRows(Y, [1], np.zeros(2, dtype=bool)).about(TRUE, b - Y @ TRUE)
    np.testing.assert_allclose(columns[:, 1] @ TRUE, 0.0, atol=1e-12)
    np.testing.assert_array_equal(columns[:, 0], Y[:, 0])
    np.testing.assert_allclose(added[:, 1], -Y[:, 1] @ TRUE)


def test_what_rows_leave_is_compared_at_one_size() -> None:
    Y, b = rows(lack=0.5)
    free = HomogeneousRows(Y, [1], np.zeros(2, dtype=bool))
    small = 0.1 * TRUE
    one, other = (free.squares(pi, b - Y @ pi, TRUE)[1] for pi in (TRUE, small))
    assert other == pytest.approx(one)


def test_parameters_of_nothing_are_no_fit_and_no_warning() -> None:
    Y, b = rows(lack=0.5)
    free = HomogeneousRows(Y, [1], np.zeros(2, dtype=bool))
    assert not np.isfinite(free.squares(np.zeros(2), b, TRUE)[1])
