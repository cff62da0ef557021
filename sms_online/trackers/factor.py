"""Square-root information: the triangular factor of whitened rows, and the least-squares solution it holds.

A factor is the (n + 1, n + 1) upper triangle of a QR decomposition of the whitened rows [Y b],

    [ R  z ]    RᵀR = YᵀY,  Rᵀz = Yᵀb,
    [ 0  ρ ]    ρ² = residual sum of squares,

so that a factor replaces its rows in every later QR. A column of zeros, of a parameter that nothing is known of, has a
row of zeros: what the others leave is ρ alone. Householder QR is backward stable column by column (Higham,
Accuracy and Stability of Numerical Algorithms, 2002, theorem 19.4), so columns of very different units need no scaling
before the solution; and RᵀR is never formed, which would square the condition number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dgeqrf, dtpqrt

from sms_online.stream import Array

# Scaled singular values below this times the largest are rounding: QR leaves a few 1e-15, and even a balance of scaled
# condition 1e9 is four decades better than rounding.
RANK_TOLERANCE = 1e-12
# A parameter is undetermined when its unit vector has more than this in the null space. Rounding rotates the null space
# by about 1e-15 times the scaled condition number, 1e-10 at 1e5; true combinations have fractions of order one.
PARTICIPATION_TOLERANCE = 1e-6
# Columns that LAPACK works off together; of 50 as of 180 columns this is the quickest.
PANEL = 8


def triangular_factor(*stacked: Array) -> Array:
    """Factor (n + 1, n + 1) of rows and factors (…, n + 1) put below each other."""
    rows = np.concatenate(stacked)
    n1 = rows.shape[1]
    # QR gives a column of zeros a row as well, and leaves in it what belongs to the columns behind.
    places = np.append(np.flatnonzero(rows[:, :-1].any(axis=0)), n1 - 1)
    if len(rows) < places.size:
        rows = np.concatenate((rows, np.zeros((places.size - len(rows), n1))))
    if places.size == n1:
        return np.asarray(np.linalg.qr(rows, mode="r"))
    out = np.zeros((n1, n1))
    out[np.ix_(places, places)] = np.linalg.qr(rows[:, places], mode="r")
    return out


def reduced(rows: Array) -> Array:
    """The same information (k, n + 1) in no more rows than columns: rows (M, n + 1) as they are, or their triangle."""
    return rows if len(rows) <= rows.shape[1] else np.asarray(np.linalg.qr(rows, mode="r"))


def extended(factor: Array, rows: Array) -> Array:
    """Factor (n + 1, n + 1) of another one, upper triangular, and rows (M, n + 1).

    LAPACK leaves the zeros of the triangle out: with fewer rows than columns that is several times as fast.
    """
    if not len(rows):
        return factor
    return np.ascontiguousarray(dtpqrt(0, min(PANEL, len(factor)), factor, rows)[0])


def raw_triangle(rows: Array) -> Array:
    """R with Rᵀ R = rowsᵀ rows in its upper triangle; below it there is what LAPACK leaves there.

    Of small matrices NumPy's checks would cost more than the decomposition.
    """
    return np.asarray(dgeqrf(rows, lwork=PANEL * rows.shape[1])[0])


@dataclass(frozen=True)
class Solution:
    """Least-squares solution of a factor.

    pi: (n,). root: (n, rank) with covariance = root rootᵀ on the determined parameters. determined: (n,) bool.
    condition_number: of the column-scaled R. rss: ‖b − Y π‖² of the whitened rows.
    """

    pi: Array
    root: Array
    determined: np.ndarray[tuple[int], np.dtype[np.bool_]]
    condition_number: float
    rss: float

    @property
    def rank(self) -> int:
        """Number of directions that the rows determine."""
        return int(self.root.shape[1])

    def covariance(self, meat: Array | None = None) -> Array:
        """Covariance (n, n) of π, root·meat·rootᵀ; without `meat` (rank, rank) that of rows with their stated std."""
        C = self.root @ self.root.T if meat is None else self.root @ meat @ self.root.T
        return masked_covariance(C, self.determined)


def masked_covariance(C: Array, determined: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Array:
    """C (n, n), symmetric to the bit, with infinite variance and zeros beside it where not determined (n,)."""
    out = np.where(np.outer(determined, determined), 0.5 * (C + C.T), 0.0)
    out[~determined, ~determined] = np.inf
    return out


def solve(rows: Array) -> Solution:
    """Least-squares solution of whitened rows or a factor (M, n + 1), M > n, by SVD of the column-scaled matrix.

    Directions without information are left at zero (minimum norm in units of 1/column norm).
    Source: Golub and Van Loan, Matrix Computations, 2013, 5.5 (rank-deficient least squares).
    """
    n = rows.shape[1] - 1
    norm = np.linalg.norm(rows[:, :n], axis=0)
    scale = np.where(norm > 0, norm, 1.0)
    U, s, Vt = np.linalg.svd(rows[:, :n] / scale, full_matrices=False)
    rank = int(np.count_nonzero(s > RANK_TOLERANCE * s[0]))
    null = Vt[rank:]
    root = Vt[:rank].T / s[:rank] / scale[:, None]
    c = U[:, :rank].T @ rows[:, n]
    residual = rows[:, n] - U[:, :rank] @ c
    return Solution(
        pi=root @ c,
        root=root,
        determined=np.linalg.norm(null, axis=0) <= PARTICIPATION_TOLERANCE,
        condition_number=float(s[0] / s[-1]) if rank == n else np.inf,
        rss=float(residual @ residual),
    )
