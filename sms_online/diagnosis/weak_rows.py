"""Rows of windows with the covariance of their noise: linear algebra alone, whatever they are rows of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.pipeline.momentum_windows import HOPS
from sms_online.pipeline.whitening import Whitening
from sms_online.stream import Array


class WeakRows:
    """Rows Y β = b of W windows, n_v a window, errors and all.

    Y (W, n_v, n), b (W, n_v). sample_rate: of what they are from, Hz. Once their noise is known: std (W, n_v), each
    row's own predicted deviation; white_std (W, n_v), that of a row beside those before it. weights (n,): parameters
    that predict it, None where it is known without any.
    """

    std: Array
    weights: Array | None = None
    _covariances: Sequence[Sequence[Array]]
    _whitening: Whitening

    def __init__(self, Y: Array, b: Array, sample_rate: float) -> None:
        self.Y, self.b, self.sample_rate = Y, b, sample_rate

    @property
    def count(self) -> int:
        """Number of windows W."""
        return len(self.b)

    def have_noise(self, covariances: Sequence[Sequence[Array]]) -> None:
        """Take the covariances of each window's rows with those before, oldest first, then their own, and whiten."""
        self._covariances = covariances
        self.std = np.sqrt([np.diag(own[-1]) for own in covariances]).reshape(self.b.shape)
        self.whiten(np.zeros_like(self.std))

    def whiten(self, own: Array, free: Array | None = None) -> None:
        """Make the windows' rows independent; own (W, n_v): further variance of each row, an error of its own.

        free (W, HOPS, n_v): further covariances, see `WeakWindows.shared`.
        """
        covariances = self._covariances
        if free is not None:
            added = np.zeros((*free.shape, free.shape[2]))
            np.einsum("whvv->whv", added)[:] = free
            covariances = [
                [one + other for one, other in zip(some, more[: len(some)][::-1], strict=True)]
                for some, more in zip(covariances, added, strict=True)
            ]
        self._whitening = Whitening(covariances, own)

    @property
    def white_std(self) -> Array:
        """See above."""
        return self._whitening.std

    def white(self, columns: Array) -> Array:
        """Columns (W, n_v, c) in the whitened rows, (W n_v, c)."""
        return self._whitening.of(columns)

    def freedom(self, speeds: Sequence[int]) -> float:
        """Degrees of freedom of the mean square of some speeds' rows over their variance, which overlapping rows share.

        2 / variance of the mean of squares of correlated normal numbers: (W S)² / Σ ρ².
        """
        total = 0.0
        variance = self.std[:, speeds] ** 2
        for lag in range(HOPS):
            later = [k for k, covariances in enumerate(self._covariances) if len(covariances) > lag]
            if later:
                blocks = np.array([self._covariances[k][-1 - lag] for k in later])[:, speeds][..., speeds]
                scale = variance[later, :, None] * variance[np.array(later) - lag, None, :]
                total += (1.0 if lag == 0 else 2.0) * float(np.sum(blocks**2 / scale))
        return (self.count * len(speeds)) ** 2 / total
