"""How much of a model's residual each candidate explains: whitened least squares of many columns at once.

With Q an orthonormal basis of the columns that the model has, r = (I - QQᵀ) b is its residual and Z⊥ = (I - QQᵀ) Z what
a candidate adds. The candidate lowers the residual sum of squares by |P r|², P the projection on Z⊥: twice the log of
the likelihood ratio, a χ² with as many degrees of freedom as Z⊥ has columns where the candidate is absent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls
from scipy.stats import chi2

from sms_online.stream import Array, Indices, Mask
from sms_online.trackers.interface import Prior

# A column of which the model leaves less than this share is a combination of what it has.
FREE = 1e-5
# Rounding of a projection grows as what it leaves shrinks: below this share it is done twice.
TWICE = 1e-2
# Singular values below this share of the largest, of columns scaled to unit length, are not solved for.
RANK_TOLERANCE = 1e-10
# Solutions by a triangular factor, or parts of one, are right to 1e-10 where no direction is smaller than this.
WELL_CONDITIONED = 1e-6


def basis(columns: Array) -> Array:
    """Orthonormal basis (M, rank) of columns (M, n)."""
    if columns.shape[1] == 0:
        return columns
    norm = np.linalg.norm(columns, axis=0)
    U, s, _ = np.linalg.svd(columns / np.where(norm > 0.0, norm, 1.0), full_matrices=False)
    return np.asarray(U[:, s > RANK_TOLERANCE * s[0]])


def solution_of(gram: Array, raw: Array) -> Array:
    """Least squares (c,) of columns whose products with each other and with b, last, are gram (c + 1, c + 1).

    raw (c,): squares of the columns before their means, or what else they have in common, were taken off. A column of
    which only rounding is left has zero.
    """
    squares = np.diag(gram)[:-1]
    varies = np.flatnonzero(squares > RANK_TOLERANCE * raw)
    size = np.sqrt(squares[varies])
    scaled = gram[np.ix_(varies, varies)] / np.outer(size, size)
    out = np.zeros(squares.size)
    out[varies] = np.linalg.lstsq(scaled, gram[varies, -1] / size, rcond=RANK_TOLERANCE)[0] / size
    return out


def free_of(Q: Array, columns: Array) -> Array:
    """What of columns (M, c) is orthogonal to the basis Q (M, rank)."""
    free = np.asarray(columns - Q @ (Q.T @ columns))
    again = np.linalg.norm(free, axis=0) < TWICE * np.linalg.norm(columns, axis=0)
    if again.any():
        free[:, again] -= Q @ (Q.T @ free[:, again])
    return free


def least_squares(columns: Array, b: Array) -> Array:
    """Solution (n,) for columns (M, n) and b (M,), of minimum norm in units of the columns' sizes."""
    size = np.linalg.norm(columns, axis=0)
    size[size == 0.0] = 1.0
    R = np.asarray(np.linalg.qr(np.column_stack((columns / size, b)), mode="r"))
    n = size.size
    if len(R) >= n and _well_conditioned(R[:n, :n]):
        return np.asarray(solve_triangular(R[:n, :n], R[:n, n]) / size)
    return np.asarray(np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=RANK_TOLERANCE)[0] / size)


def fitted(columns: Array, b: Array, positive: Mask) -> Array:
    """Least squares (n,) for columns (M, n) and b (M,), those positive (n,) kept from being negative."""
    R = np.asarray(np.linalg.qr(np.column_stack((columns, b)), mode="r"))
    columns, b = R[:, :-1], R[:, -1]
    solution = least_squares(columns, b)
    return bounded(columns, b, positive) if np.any(solution[positive] < 0.0) else solution


def bounded(columns: Array, b: Array, positive: Mask) -> Array:
    """Least squares (n,) for columns (M, n) and b (M,) of which those positive (n,) are not negative.

    Source: Lawson and Hanson, Solving Least Squares Problems, 1974, chapter 23.
    """
    order = np.concatenate((np.flatnonzero(~positive), np.flatnonzero(positive)))
    size = np.linalg.norm(columns, axis=0)[order]
    size[size == 0.0] = 1.0
    R = np.asarray(np.linalg.qr(np.column_stack((columns[:, order] / size, b)), mode="r"))
    n, free = order.size, int(np.count_nonzero(~positive))
    # What the columns without a bound leave is a problem of the others alone.
    if len(R) >= free and _well_conditioned(R[:free, :free]):
        rest = R[free:, free:].copy()
    else:
        rest = free_of(basis(R[:, :free]), R[:, free:])
    # A column that they make too is rounding now.
    rest[:, :-1][:, np.linalg.norm(rest[:, :-1], axis=0) <= RANK_TOLERANCE * np.linalg.norm(R[:, free:n], axis=0)] = 0.0
    own = nnls(rest[:, :-1], rest[:, -1])[0]
    out = np.empty(n)
    out[order] = np.concatenate((least_squares(R[:, :free], R[:, n] - R[:, free:n] @ own), own)) / size
    return out


def _well_conditioned(R: Array) -> bool:
    """Whether no direction of columns with this triangular factor (n, n) is small."""
    diagonal = np.abs(np.diag(R))
    return bool(diagonal.min(initial=np.inf) > WELL_CONDITIONED * diagonal.max(initial=0.0))


def together(columns: Array, b: Array, prior: Prior | None) -> Array:
    """Solution (n + c,) for columns (W, n_v, n + c) of a model and of all candidates, and b (W, n_v).

    Parameters that are known beforehand keep their values: where a model lacks much, parameters that shrink to zero
    would explain rows without a torque.
    """
    known = np.zeros(columns.shape[2], dtype=bool)
    solution = np.zeros(columns.shape[2])
    if prior is not None:
        known[: prior.known.size] = prior.known
        solution[known] = prior.value[prior.known]
    left = b - columns[..., known] @ solution[known]
    solution[~known] = least_squares(columns[..., ~known].reshape(b.size, -1), left.ravel())
    return solution


def least_squares_without(columns: Array, b: Array, left_out: Sequence[Mask], positive: Mask) -> Array:
    """Solutions (B, n) for columns (M, n) and b (M,) without each of some sets of rows (M,), from one factorisation.

    positive (n,): which are not negative. Where columns are nearly dependent, or are so without a set,
    each is solved for itself. Source: the block form of leaving one out, Cook and Weisberg, Residuals and Influence in
    Regression, 1982, section 3.6.
    """
    size = np.linalg.norm(columns, axis=0)
    size[size == 0.0] = 1.0
    Q, R = np.linalg.qr(columns / size)
    n = columns.shape[1]
    if len(columns) < n or not _well_conditioned(R):
        return np.array([fitted(columns[~each], b[~each], positive) for each in left_out])
    along = Q.T @ b
    residual, out = b - Q @ along, np.empty((len(left_out), n))
    for k, each in enumerate(left_out):
        own = Q[each]
        kept = np.eye(n) - own.T @ own
        if np.linalg.eigvalsh(kept)[0] <= WELL_CONDITIONED:
            out[k] = fitted(columns[~each], b[~each], positive)
            continue
        moved = along - np.linalg.solve(kept, own.T @ residual[each])
        out[k] = solve_triangular(R, moved) / size
        if np.any(out[k, positive] < 0.0):
            root = np.linalg.cholesky(kept).T
            out[k] = bounded(root @ R * size, root @ moved, positive)
    return out


@dataclass(frozen=True)
class Gain:
    """What a candidate would do: gain of the residual sum of squares, coefficients (c,), covariance (c, c).

    seen: whether any of its columns is more than a combination of what the model has.
    """

    gain: float
    coefficients: Array
    covariance: Array
    seen: bool


def gain(Q: Array, r: Array, columns: Array) -> Gain:
    """Of columns (M, c), beside a model with basis Q (M, rank) and residual r (M,)."""
    return gains(Q, r, [columns])[0]


def gains(Q: Array, r: Array, candidates: Sequence[Array]) -> list[Gain]:
    """Of the columns (M, c) of each candidate alone, beside a model with basis Q (M, rank) and residual r (M,)."""
    if not candidates:
        return []
    columns = np.concatenate(candidates, axis=1)
    free = free_of(Q, columns)
    size, left = np.linalg.norm(columns, axis=0), np.linalg.norm(free, axis=0)
    # Squares of columns below that are none in floating point.
    seen = left > np.maximum(FREE * size, np.sqrt(np.finfo(np.float64).tiny))
    scaled = np.divide(free, left, out=free, where=seen)
    along, start, out = scaled.T @ r, 0, []
    for each in candidates:
        own = np.arange(start, start + each.shape[1])
        start += own.size
        out.append(_gain(scaled, along, left, own, seen[own]))
    return out


def _gain(scaled: Array, along: Array, left: Array, own: Indices, seen: Mask) -> Gain:
    """Of columns `own` of unit columns (M, ·) of sizes `left`, and what they take of the residual."""
    c, kept = own.size, own[seen]
    coefficients, covariance = np.zeros(c), np.diag(np.full(c, np.inf))
    if not kept.size:
        return Gain(0.0, coefficients, covariance, False)
    if kept.size == 1:
        (k,) = kept
        coefficients[seen], covariance[np.ix_(seen, seen)] = along[k] / left[k], 1.0 / left[k] ** 2
        return Gain(float(along[k] ** 2), coefficients, covariance, True)
    squares, vectors = np.linalg.eigh(scaled[:, kept].T @ scaled[:, kept])
    rank = squares > FREE**2 * squares[-1]
    root = vectors[:, rank] / np.sqrt(squares[rank])
    part = root.T @ along[kept]
    root = root / left[kept, None]
    coefficients[seen] = root @ part
    covariance[np.ix_(seen, seen)] = root @ root.T
    return Gain(float(part @ part), coefficients, covariance, True)


@cache
def threshold(level: float, trials: int, freedom: int) -> float:
    """Gain that the best of so many absent candidates of `freedom` columns exceeds with probability `level` at most."""
    return float(chi2.isf(level / trials, freedom))
