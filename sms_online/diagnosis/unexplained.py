"""What can be said of a residual that no known effect explains: where it is, and what it depends on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sms_online.diagnosis.evidence import basis, free_of, gain, least_squares
from sms_online.diagnosis.residuals import RowResidual
from sms_online.diagnosis.rows import SessionRows
from sms_online.diagnosis.splines import DEGREE, Variable, design, spline_columns
from sms_online.row_types import row_types
from sms_online.stream import Array

# Cubic splines on so many intervals of a variable's range.
INTERVALS = 8
# A residual takes its course from something that was found where this explains more of its squares than not.
SAME_COURSE = 0.5
# Windows for a column at least, for that to be no chance.
LEAST_WINDOWS = 20
# Points at which a spline is reported.
POINTS = 25


@dataclass(frozen=True)
class Unexplained:
    """A force in place of what is not known.

    row: row type with most of the residual, before and after what was found, or in which something was found that takes
    the same course. speed: the generalized speed whose rows hold it still. variable: what the force depends on most
    clearly. share: of the residual's excess over noise in all rows that it takes away. at, force (POINTS,): the force
    over the variable's range, in N m (N).
    """

    row: str
    speed: str
    variable: str
    share: float
    at: Array
    force: Array


def describe_residual(
    rows: SessionRows, columns: Array, residual: Array, before: Mapping[str, RowResidual]
) -> Unexplained:
    """Find row and variable.

    columns (W, n_v, n): of the model with what was adopted; residual (W, n_v): of it; before: of the model without, by
    row type.
    """
    layout = rows.model.layout
    excess = np.sum(residual**2 - 1.0, axis=0)
    # A wrong effect clears rows of the right one at the cost of others: the row is one that had much and still has.
    by_type = {
        name: float(excess[speeds].sum()) * before[name].whitened ** 2 for name, speeds in row_types(layout).items()
    }
    row = max(by_type, key=lambda name: by_type[name])
    speed = max(row_types(layout)[row], key=lambda k: excess[k])
    aside = _speed_with_same_residual(rows, columns[..., rows.base.n :], residual[:, speed], speed)
    beside = next((name for name, speeds in row_types(layout).items() if aside in speeds), row)
    row = max(row, beside, key=lambda name: before[name].whitened)
    Q = basis((columns / rows.std[..., None]).reshape(-1, columns.shape[2]))
    r = free_of(Q, residual.reshape(-1, 1))[:, 0]
    best = None
    for name, variable in _variables(rows, speed).items():
        knots = _knots(rows, variable)
        if knots is None:
            continue
        spline = spline_columns(rows, variable, knots, np.eye(layout.n_v)[speed]) / rows.std[..., None]
        found = gain(Q, r, spline.reshape(-1, spline.shape[2]))
        if best is None or found.gain > best[0].gain:
            best = found, name, knots
    assert best is not None
    found, name, knots = best
    at = np.linspace(knots[DEGREE], knots[-1 - DEGREE], POINTS)
    share = min(1.0, found.gain / max(float(excess.sum()), float(np.finfo(np.float64).tiny)))
    return Unexplained(row, layout.speed_names[speed], name, share, at, design(at, knots) @ found.coefficients)


def _speed_with_same_residual(rows: SessionRows, columns: Array, left: Array, speed: int) -> int | None:
    """The speed whose rows have the same course of residual, where an effect explains half of one force; None if none.

    columns (W, n_v, c): of what was found; left (W,): residual of the other speed. A gear's error drives the motor and
    the link: what takes it for a force on the motor alone leaves the same course in the link's rows.
    """
    main = np.argmax(np.sum((columns / rows.std[..., None]) ** 2, axis=0), axis=0)
    scaled = columns[:, main, np.arange(main.size)] / rows.std[:, [speed]]
    sizes = np.linalg.norm(scaled, axis=0)
    if not np.any(sizes) or left.size < LEAST_WINDOWS * sizes.size:
        return None
    coefficients = least_squares(scaled, left)
    if 1.0 - np.sum((left - scaled @ coefficients) ** 2) / np.sum(left**2) < SAME_COURSE:
        return None
    return int(main[np.argmax(np.abs(coefficients) * sizes)])


def _variables(rows: SessionRows, speed: int) -> dict[str, Variable]:
    """What a force on a speed may depend on: positions and speeds, deflections of joints, torques, time.

    Not the torque on that very speed, which explains itself, with an arm that has no mass.
    """
    layout = rows.model.layout
    out = {name: _part("x", k) for k, name in enumerate(layout.position_names)}
    out |= {f"rate of {name}": _part("v", k) for k, name in enumerate(layout.speed_names)}
    for i, (q, theta_m) in enumerate(zip(layout.q, layout.theta_m, strict=True)):
        if q != theta_m:
            out[f"deflection of joint_{i + 1}"] = _difference(theta_m + layout.offset, q + layout.offset)
        if speed not in (q, theta_m):
            out[f"torque of joint_{i + 1}"] = _part("torque", i)
    rate = rows.model.system.sample_rate
    out["time"] = lambda motion: (rows.segments[motion.segment].index[0] + motion.samples) / rate
    return out


def _part(part: str, k: int) -> Variable:
    return lambda motion: getattr(motion, part)[:, k]


def _difference(k: int, minus: int) -> Variable:
    return lambda motion: motion.x[:, k] - motion.x[:, minus]


def _knots(rows: SessionRows, variable: Variable) -> Array | None:
    """Knots over the range that the variable goes through, None where it is constant."""
    values = np.concatenate([variable(motion) for motion, _ in rows.weak.motions()])
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return None
    inner = np.linspace(low, high, INTERVALS + 1)
    return np.concatenate((np.full(DEGREE, low), inner, np.full(DEGREE, high)))
