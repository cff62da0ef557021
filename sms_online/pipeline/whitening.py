"""Rows of overlapping windows made independent of each other: sequential whitening.

Rows of windows that overlap share noise, so their covariance is block-banded, and so is its Cholesky factor L: those
of L⁻¹ [Y b] have independent errors of standard deviation one. A window's whitened rows are its innovations: what its
rows say beside all windows before it, in units of their deviation. The factor grows by one window at a time, of which
it keeps those that the next one overlaps; the same rows of L whiten any further columns later.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress

import msgspec
import numpy as np
from scipy.linalg import cholesky_banded
from scipy.linalg.lapack import dtbtrs, dtrtrs

from sms_online.state import Stage, State
from sms_online.stream import Array

# Shares of a row's variance that are added to it alone: for the rounding of the factorisation, and more where that is
# too little, as what dry friction makes of noise is a covariance but for the quadrature of its parts.
ROUNDING, COARSER = 1e-13, (1e-10, 1e-8, 1e-6)


class Factor(State):
    """Cholesky factor of the windows' covariance, one window after the other."""

    L: Array = msgspec.field(default_factory=lambda: np.empty((0, 0)))  # of the last window and those that overlap it

    def push(self, covariances: Sequence[Array], errors: Array | float = 0.0) -> Array:
        """The next window's rows of L (n_v, m n_v), its own block last.

        covariances (m of (n_v, n_v)): with the windows before that it overlaps, oldest first, then its own. errors
        (n_v,): further variance of each row, of its own. Raises numpy.linalg.LinAlgError where the covariance is not
        positive definite.
        """
        own = covariances[-1]
        n_v, variance = len(own), np.diag(own)
        size = n_v * (len(covariances) - 1)
        L = self.L[len(self.L) - size :, len(self.L) - size :]
        cross = np.concatenate([np.empty((n_v, 0)), *covariances[:-1]], axis=1).T  # (size, n_v)
        X = forward_solved(L, cross) if size else cross

        def factor(share: float) -> Array:
            return np.linalg.cholesky(own + np.diag(share * variance + errors) - X.T @ X)

        self.L = np.zeros((size + n_v, size + n_v))
        self.L[:size, :size] = L
        self.L[size:, :size], self.L[size:, size:] = X.T, _positive(factor)
        return self.L[size:]


def _positive(factor: Callable[[float], Array]) -> Array:
    """What `factor` gives of the least share of its variance that makes a matrix positive definite; LinAlgError."""
    for share in (ROUNDING, *COARSER[:-1]):
        with suppress(np.linalg.LinAlgError):
            return factor(share)
    return factor(COARSER[-1])


def forward_solved(L: Array, right: Array) -> Array:
    """L⁻¹ times right-hand sides, L lower triangular: by LAPACK itself, for SciPy's checks take longer than it."""
    solution, _ = dtrtrs(L.T, right, lower=0, trans=1)
    return np.asarray(solution)


class WhitenerState(State):
    """What is kept of the windows that the next one may overlap.

    white (·, width): whitened rows of the windows that the next one may overlap.
    """

    white: Array
    factor: Factor


class Whitener(Stage):
    """Whitens rows [Y b] as windows come."""

    def __init__(self, width: int) -> None:
        self._width = width
        self.begin_segment()

    def begin_segment(self) -> None:
        """The next window shares no noise with those before."""
        self.state = WhitenerState(np.empty((0, self._width)), Factor())

    def push(self, covariances: Sequence[Array], rows: Array) -> Array:
        """Whitened rows (n_v, width) of the next window's (n_v, width), with covariances as `Factor` takes them."""
        own = self.state.factor.push(covariances)
        seen = own.shape[1] - len(own)
        white = self.state.white[len(self.state.white) - seen :]
        out = forward_solved(own[:, seen:], rows - own[:, :seen] @ white)
        self.state.white = np.concatenate((white, out))
        return out


class Whitening:
    """Whitens any columns of the rows of W windows, all of which are there: by one banded factor.

    std (W, n_v): deviation of each row beside those before it.
    """

    def __init__(self, covariances: Sequence[Sequence[Array]], errors: Array) -> None:
        """covariances, errors (W, n_v): of each window as `Factor` takes them; LinAlgError as it raises it."""
        W, n_v = errors.shape
        reach = max((len(some) for some in covariances), default=0)
        row, column = np.indices((n_v, n_v))

        def factor(share: float) -> Array:
            # Lower band: entry (i, j) is at (i - j, j).
            band = np.zeros((max(1, reach * n_v), W * n_v))
            for hops in range(reach):
                later = np.array([k for k, some in enumerate(covariances) if len(some) > hops])
                blocks = np.array([covariances[k][-1 - hops] for k in later.tolist()])
                below = hops * n_v + row - column
                own = below >= 0
                band[below[own], (later - hops)[:, None] * n_v + column[own]] = blocks[:, own]
            band[0] += share * band[0] + errors.ravel()
            return cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False) if W else band

        self._factor = _positive(factor)
        self.std: Array = self._factor[0].reshape(W, n_v)

    def of(self, columns: Array) -> Array:
        """Columns (W, n_v, c) in the whitened rows, (W n_v, c)."""
        flat = columns.reshape(self.std.size, columns.shape[2])
        return np.asarray(dtbtrs(self._factor, flat, uplo="L")[0]) if flat.size else flat
