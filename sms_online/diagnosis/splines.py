"""A force of one variable as a spline, in the rows of a session."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import BSpline

from sms_online.diagnosis.rows import SessionRows
from sms_online.diagnosis.weak_windows import SeenMotion
from sms_online.stream import Array

# Degree of all splines.
DEGREE = 3

# Values (K,) along a motion.
Variable = Callable[[SeenMotion], Array]


def design(values: Array, knots: Array) -> Array:
    """B-splines (K, c) at values (K,), those beyond the knots put on the nearest end."""
    inside = np.clip(values, knots[0], knots[-1])
    return np.asarray(BSpline.design_matrix(inside, knots, DEGREE).toarray())


def spline_columns(rows: SessionRows, variable: Variable, knots: Array, direction: Array, dense: bool = False) -> Array:
    """Columns (W, n_v, c) of one unit of each B-spline of a variable as a force along a direction (n_v,).

    dense: see `WeakWindows.columns`.
    """

    def weak(motion: SeenMotion) -> tuple[None, Array]:
        return None, direction[:, None] * design(variable(motion), knots)[:, None, :]

    return rows.weak.columns(weak, dense)
