"""What noise in the columns does to a least-squares estimate, measured by adding more of it.

Noise enters the columns too, and products square it: the expectation of YᵀY and of Yᵀb is off in second order, which
biases the estimate. The same noise once more, added and subtracted, changes their mean by as much again, so that
2 YᵀY - ½ (Y₊ᵀY₊ + Y₋ᵀY₋) is free of it in second order. The first orders cancel in the pair. Noise that a parameter
multiplies is in its column and in b alike: its square is taken off both products, see `multiplied_noise`.
Sources: Cook and Stefanski, J. American Statistical Association 89 (1994) 1314 (simulation extrapolation); Novick and
Stefanski, ibid. 97 (2002) 472 (corrected scores by simulation). The comparison of a consistent estimate with an
efficient one as an alarm: Hausman, Econometrica 46 (1978) 1251.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.special import stdtrit

from sms_online.calibration.nuisance import Nuisance
from sms_online.calibration.release import released
from sms_online.pipeline.gram_sum import take_off
from sms_online.state import State
from sms_online.stream import Array, Indices, Mask
from sms_online.trackers.interface import Estimate

# Windows that share samples answer for noise together; a cluster is of windows side by side.
CLUSTER = 20
# Probability by Student's distribution from which on a shift counts: two standard deviations of many clusters.
EVIDENCE = 0.97725
# Along a direction of whose information noise makes this share or more nothing is corrected, for small errors of the
# share would be large ones of the correction. What it would be counts as a deviation, so many times the estimate at
# most.
LARGEST_SHARE, LARGEST_FACTOR = 0.5, 100.0
# What a parameter multiplies is taken off but for this share of the information along a direction, or so many times
# what a sample of it scatters by.
LEAST_LEFT, SCATTER = 0.02, 2.0
# When there are so many clusters, neighbours merge.
MOST_CLUSTERS = 128


class NoiseBias(State):
    """Gathers normal equations with and without additional noise, in columns and right-hand sides.

    gram (n + 1, n + 1): of rows [Y b]. whole: what additional noise changes, by clusters of `length` windows, in order
    of time; last: of the cluster that windows still join, `joined` so far. multiplying: parameters that multiply noise,
    which b holds too; shared (k,): sum of its squares, see `multiplied_noise`.
    """

    gram: Array
    last: Array
    whole: list[Array] = msgspec.field(default_factory=list)
    length: int = CLUSTER
    joined: int = 0
    multiplying: tuple[int, ...] = ()
    shared: Array | None = None

    @staticmethod
    def none(n: int, prior: Array | None = None, multiplying: Sequence[int] = ()) -> NoiseBias:
        """Bias of no rows; prior (k, n + 1): what is known beforehand, as rows [Y b] of unit variance without noise.

        multiplying: parameters that multiply noise.
        """
        gram, last = np.zeros((2, n + 1, n + 1))
        return NoiseBias(gram if prior is None else prior.T @ prior, last, multiplying=tuple(multiplying))

    def add(self, rows: Array, noisy: Array, shared: Array | None = None) -> None:
        """Rows [Y b] (M, n + 1) of a window, and the same with noise added and subtracted (2, M, n + 1).

        shared (M, ·): a sample of what parameters multiply: noise of their columns, and of b.
        """
        gram = rows.T @ rows
        self.gram = self.gram + gram
        if self.joined == 0 and len(self.whole) == MOST_CLUSTERS:
            self.whole = [one + other for one, other in zip(self.whole[::2], self.whole[1::2], strict=True)]
            self.length *= 2
        changed = 0.5 * (noisy[0].T @ noisy[0] + noisy[1].T @ noisy[1]) - gram
        if shared is not None and shared.any():
            squares = np.sum(shared**2, axis=0)
            take_off(changed, self.multiplying, -squares)
            self.shared = squares if self.shared is None else self.shared + squares
        self.last = self.last + changed
        self.joined = (self.joined + 1) % self.length
        if self.joined == 0:
            self.whole.append(self.last)
            self.last = np.zeros_like(self.last)

    @property
    def windows(self) -> int:
        """How many there were."""
        return len(self.whole) * self.length + self.joined

    @property
    def _clusters(self) -> Array:
        """All of them (C, n + 1, n + 1), in order of time."""
        return np.array(self.whole if self.joined == 0 else [*self.whole, self.last]).reshape(-1, *self.gram.shape)

    def correction(self, determined: Mask, lost_unknown: bool = False) -> Correction:
        """What to add to the least-squares estimate to free it of this bias, and to its covariance.

        What parameters multiply is taken off the normal equations before all else.

        The synthetic noise is one sample, so the shift scatters. As much of it is given as is no scatter: a bias that
        many clusters agree on counts, one that few of them make shrinks to zero as James and Stein's estimate does.
        What it shrinks by may be bias all the same, and counts as a deviation.

        The scatter is also what the session's own noise does to the estimate in second order. With Y = Y₀ + L and
        errors e = l + q of first and of second order, Yᵀ e holds Y₀ᵀ q + Lᵀ l besides Y₀ᵀ l, and the pair changes the
        score by the same function of a noise of the same law. Even orders of Gaussian noise do not correlate with odd
        ones, so the variances add: that of the second order to that of the first, and to both that of the shift.
        Where noise makes most of the information along a direction, the motion does not determine it: least squares
        attenuate it by an unknown factor. There the shift is zero and its size a deviation; of the largest factor for
        `lost_unknown`, so that anything else that is known prevails. Zero where nothing is determined.
        """
        shift, squares = np.zeros((2, determined.size)), np.zeros((2, determined.size, determined.size))
        known = np.flatnonzero(determined)
        rows = np.append(known, determined.size)
        size = np.sqrt(np.diag(self.gram)[rows])
        if known.size == 0 or not (size > 0.0).all():
            return Correction(*shift, *squares)
        scale = np.outer(size, size)
        gram, clusters = self.gram[np.ix_(rows, rows)] / scale, self._clusters
        if self.shared is not None:
            take_off(clusters, self.multiplying, self.shared / len(clusters))
            gram, shift[0, known], squares[0][np.ix_(known, known)] = self._without_shared(gram, rows, size)
        clusters = clusters[:, rows[:, None], rows] / scale
        # A column that is noise alone may make any multiple of its square: more than some would drown the others.
        own = np.abs(np.diag(clusters.sum(axis=0)))
        limit = np.sqrt(np.divide(LARGEST_FACTOR, own, out=np.ones_like(own), where=own > LARGEST_FACTOR))
        clusters = clusters * np.outer(limit, limit)
        changed = clusters.sum(axis=0)
        if not changed.any():
            # Directions of exact rows may be known so differently that rounding would move them.
            return Correction(*shift, *squares)
        # Directions of unit information, and the share of it that noise makes.
        values, vectors = np.linalg.eigh(gram[:-1, :-1])
        root = vectors / np.sqrt(np.maximum(values, np.finfo(np.float64).eps * values[-1]))
        share, axes = np.linalg.eigh(root.T @ changed[:-1, :-1] @ root)
        directions = root @ axes
        along = directions.T @ gram[:-1, -1]
        lost = share >= LARGEST_SHARE
        kept = directions[:, ~lost]
        whole = (kept.T @ (gram - changed)[:-1, -1]) / (1.0 - share[~lost]) - along[~lost]
        apart = np.abs(1.0 - share[lost])
        factor = np.clip(share[lost] / np.maximum(apart, 1.0 / LARGEST_FACTOR), 1.0, LARGEST_FACTOR)
        attenuated = along[lost] * (LARGEST_FACTOR if lost_unknown else factor)
        # Each cluster's part of it, to first order.
        parts = kept.T @ (clusters[:, :-1] @ np.append(directions @ along, -1.0)).T
        count = parts.shape[1]
        if count > 1:
            parts = (parts - parts.mean(axis=1, keepdims=True)) * np.sqrt(count / (count - 1.0))

        def certain(whole: Array, parts: Array) -> Array:
            """Share of a shift (k,) that is no scatter of its parts (k, C)."""
            doubt = stdtrit(max(1, count - 1), EVIDENCE) ** 2 * np.sum(parts**2, axis=1)
            return np.asarray(1.0 - np.divide(doubt, whole**2, out=np.ones_like(doubt), where=whole**2 > doubt))

        unit = size[-1] / size[:-1]
        # Direction by direction: parameters that rows know together are shifted together.
        shift[1, known] = kept @ (certain(whole, parts) * whole) * unit
        whole, parts = kept @ whole, kept @ parts
        share = certain(whole, parts)
        spread = np.concatenate(
            (parts, share[:, None] * parts, np.diag((1.0 - share) * whole), directions[:, lost] * attenuated), axis=1
        )
        spread *= unit[:, None]
        squares[1][np.ix_(known, known)] = spread @ spread.T
        return Correction(*shift, *squares)

    def _without_shared(self, gram: Array, rows: Indices, size: Array) -> tuple[Array, Array, Array]:
        """Normal equations (k + 1, k + 1) of some rows and columns, scaled by their size, without what is multiplied.

        And what that adds to the solution (k,) and to its covariance (k, k).
        Along a direction that little else determines as much of it stays as its sample scatters by.
        """
        assert self.shared is not None
        squares = np.zeros(len(self.gram))
        squares[list(self.multiplying)] = self.shared
        shared = np.diag(squares[rows] / size**2)[:-1, :-1]
        values, vectors = np.linalg.eigh(gram[:-1, :-1])
        length = np.sqrt(np.maximum(values, np.finfo(np.float64).eps * values[-1]))
        share, axes = np.linalg.eigh((vectors / length).T @ shared @ (vectors / length))
        most = 1.0 - max(LEAST_LEFT, SCATTER * np.sqrt(2.0 / self.windows))
        share = np.clip(share, 0.0, max(0.0, most))
        # Directions of unit information, and what gives the coordinates along them.
        directions, coordinates = vectors / length @ axes, vectors * length @ axes
        shared = (coordinates * share) @ coordinates.T
        # Its products with the right-hand side are those with a gain of one.
        one = np.where(squares[rows[:-1]] > 0.0, size[:-1], 0.0) / size[-1]
        out = gram.copy()
        out[:-1, :-1] -= shared
        out[:-1, -1] -= shared @ one
        out[-1, :-1] = out[:-1, -1]
        # (A - S)⁻¹ - A⁻¹
        wider = (directions * (share / (1.0 - share))) @ directions.T
        moved = wider @ out[:-1, -1] + directions @ (directions.T @ (out[:-1, -1] - gram[:-1, -1]))
        return out, moved * size[-1] / size[:-1], wider / np.outer(size[:-1], size[:-1])

    @property
    def parameters(self) -> int:
        """Number n of parameters."""
        return int(self.gram.shape[0]) - 1

    def widen(self, more: int) -> None:
        """Go on with so many parameters more, in which the rows so far have no part."""
        at = [self.gram.shape[0] - 1] * more

        def widened(gram: Array) -> Array:
            return np.insert(np.insert(gram, at, 0.0, 0), at, 0.0, 1)

        self.gram, self.last = widened(self.gram), widened(self.last)
        self.whole = [widened(cluster) for cluster in self.whole]


class Correction(NamedTuple):
    """What frees an estimate of the bias that noise makes, and what that adds to its covariance.

    multiplied (n,), squares (n, n): for what parameters multiply, which is no information. columns (n,), uncertain
    (n, n): for noise in the columns beside it.
    """

    multiplied: Array
    columns: Array
    squares: Array
    uncertain: Array

    @property
    def shift(self) -> Array:
        """To add to the estimate (n,)."""
        return self.multiplied + self.columns


def unbiased(
    estimate: Estimate, bias: NoiseBias, nuisances: Sequence[Nuisance] = (), lost_unknown: bool = False
) -> Estimate:
    """A least-squares estimate free of what noise does, and of contradicted tolerances of nuisances.

    Nuisances come first. One that was weighted against a prior keeps the bias. See `NoiseBias.correction`, `released`.
    """
    squares = estimate.covariance
    if estimate.scale is None:
        found = bias.correction(estimate.determined, lost_unknown)
        squares = squares + found.squares
        estimate = replace(estimate, pi=estimate.pi + found.shift, covariance=squares + found.uncertain)
    return released(estimate, nuisances, squares)
