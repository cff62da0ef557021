"""What noise in the columns does to a least-squares estimate, measured by adding more of it.

Noise enters the columns too, and products square it: the expectation of YᵀY and of Yᵀb is off in second order, which
biases the estimate. The same noise once more, added and subtracted, changes their mean by as much again, so that
2 YᵀY - ½ (Y₊ᵀY₊ + Y₋ᵀY₋) is free of it in second order. The first orders cancel in the pair.
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
from sms_online.stream import Array, Mask
from sms_online.trackers.interface import Estimate

# Windows that share samples answer for noise together; a cluster is of windows side by side.
CLUSTER = 20
# Probability by Student's distribution from which on a shift counts: two standard deviations of many clusters.
EVIDENCE = 0.97725
# Along a direction of whose information noise makes this share or more nothing is corrected, for small errors of the
# share would be large ones of the correction. What it would be counts as a deviation, so many times the estimate at
# most.
LARGEST_SHARE, LARGEST_FACTOR = 0.5, 100.0
# When there are so many clusters, neighbours merge.
MOST_CLUSTERS = 128


class NoiseBias(State):
    """Gathers normal equations with and without additional noise, in columns and right-hand sides.

    gram (n + 1, n + 1): of rows [Y b]. beforehand: its part that was known before any row. whole: what additional noise
    changes, by clusters of `length` windows, in order of time; last: of the cluster that windows still join, `joined`
    so far. multiplying: parameters that multiply noise, which b holds too; shared (k,): sum of its squares.
    """

    gram: Array
    beforehand: Array
    last: Array
    whole: list[Array] = msgspec.field(default_factory=list)
    length: int = CLUSTER
    joined: int = 0
    multiplying: tuple[int, ...] = ()
    shared: Array | None = None

    @staticmethod
    def none(n: int, prior: Array | None = None, multiplying: Sequence[int] = ()) -> NoiseBias:
        """Bias of no rows; prior (k, n + 1): what is known beforehand, as rows [Y b] of unit variance without noise.

        multiplying: parameters that multiply noise, see `multiplied_noise`.
        """
        gram, last = np.zeros((2, n + 1, n + 1))
        if prior is not None:
            gram = prior.T @ prior
        return NoiseBias(gram, gram.copy(), last, multiplying=tuple(multiplying))

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
        if shared is not None and self.multiplying:
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

    def shift_by_columns(self, determined: Mask) -> Array:
        """The shift (n,) that noise in the columns asks for beside what parameters multiply, which is known exactly."""
        if self.shared is None:
            return self.correction(determined).shift
        gram, clusters = self.gram.copy(), self._clusters
        take_off(gram, self.multiplying, self.shared)
        take_off(clusters, self.multiplying, self.shared / len(clusters))
        return NoiseBias(gram, self.beforehand, np.zeros_like(gram), list(clusters)).correction(determined).shift

    def correction(self, determined: Mask, lost_unknown: bool = False) -> Correction:
        """What to add to the least-squares estimate to free it of this bias, and to its covariance.

        The synthetic noise is one sample, so the shift scatters. As much of it is given as is no scatter: a bias that
        many clusters agree on counts, one that few of them make shrinks to zero as James and Stein's estimate does.
        What it shrinks by may be bias all the same, and counts as a deviation.

        The scatter is also what the session's own noise does to the estimate in second order. With Y = Y₀ + L and
        errors e = l + q of first and of second order, Yᵀ e holds Y₀ᵀ q + Lᵀ l besides Y₀ᵀ l, and the pair changes the
        score by the same function of a noise of the same law. Even orders of Gaussian noise do not correlate with odd
        ones, so the variances add: that of the second order to that of the first, and to both that of the shift.
        Where noise makes most of the information along a direction, the motion does not determine it: least squares
        attenuate it by an unknown factor. There rows count no more than what that shift would be, as a deviation,
        allows; of the largest factor for `lost_unknown`. What was known before any row prevails. Zero where nothing is
        determined.
        """
        shift, (lost_rows, uncertain) = np.zeros(determined.size), np.zeros((2, determined.size, determined.size))
        known = np.flatnonzero(determined)
        rows = np.append(known, determined.size)
        size = np.sqrt(np.diag(self.gram)[rows])
        if known.size == 0 or not (size > 0.0).all():
            return Correction(shift, lost_rows, uncertain)
        scale = np.outer(size, size)
        gram, beforehand = self.gram[np.ix_(rows, rows)] / scale, self.beforehand[np.ix_(rows, rows)] / scale
        clusters = self._clusters[:, rows[:, None], rows] / scale
        # A column that is noise alone may make any multiple of its square: more than some would drown the others.
        own = np.abs(np.diag(clusters.sum(axis=0)))
        limit = np.sqrt(np.divide(LARGEST_FACTOR, own, out=np.ones_like(own), where=own > LARGEST_FACTOR))
        clusters = clusters * np.outer(limit, limit)
        changed = clusters.sum(axis=0)
        if not changed.any():
            # Directions of exact rows may be known so differently that rounding would move them.
            return Correction(shift, lost_rows, uncertain)
        # Directions of unit information, and the share of it that noise makes.
        values, vectors = np.linalg.eigh(gram[:-1, :-1])
        root = vectors / np.sqrt(np.maximum(values, np.finfo(np.float64).eps * values[-1]))
        share, axes = np.linalg.eigh(root.T @ changed[:-1, :-1] @ root)
        directions = root @ axes
        along = directions.T @ gram[:-1, -1]
        lost = share >= LARGEST_SHARE
        apart = np.abs(1.0 - share[lost])
        factor = np.clip(share[lost] / np.maximum(apart, 1.0 / LARGEST_FACTOR), 1.0, LARGEST_FACTOR)
        attenuated = along[lost] * (LARGEST_FACTOR if lost_unknown else factor)
        moved, widened = _beside_lost(directions, along, lost, attenuated * size[-1], beforehand)
        kept = directions[:, ~lost]
        whole = (kept.T @ (gram - changed)[:-1, -1]) / (1.0 - share[~lost]) - along[~lost]
        # Each cluster's part of it, to first order.
        parts = kept.T @ (clusters[:, :-1] @ np.append(directions @ along, -1.0)).T
        count = parts.shape[1]
        if count > 1:
            parts = (parts - parts.mean(axis=1, keepdims=True)) * np.sqrt(count / (count - 1.0))

        def certain(whole: Array, parts: Array) -> Array:
            """Share of a shift (k,) that is no scatter of its parts (k, C)."""
            doubt = stdtrit(max(1, count - 1), EVIDENCE) ** 2 * np.sum(parts**2, axis=1)
            return np.asarray(1.0 - np.divide(doubt, whole**2, out=np.ones_like(doubt), where=whole**2 > doubt))

        # Direction by direction: parameters that rows know together are shifted together.
        unit = size[-1] / size[:-1]
        shift[known] = (kept @ (certain(whole, parts) * whole) + directions @ moved) * unit
        whole, parts = kept @ whole, kept @ parts
        share = certain(whole, parts)
        spread = np.concatenate((parts, share[:, None] * parts, np.diag((1.0 - share) * whole)), axis=1)
        spread *= unit[:, None]
        uncertain[np.ix_(known, known)] = spread @ spread.T
        among = directions / size[:-1, None]
        lost_rows[np.ix_(known, known)] = among @ widened @ among.T
        return Correction(shift, lost_rows, uncertain)

    @property
    def parameters(self) -> int:
        """Number n of parameters."""
        return int(self.gram.shape[0]) - 1

    def widen(self, more: int) -> None:
        """Go on with so many parameters more, in which the rows so far have no part."""
        at = [self.gram.shape[0] - 1] * more

        def widened(gram: Array) -> Array:
            return np.insert(np.insert(gram, at, 0.0, 0), at, 0.0, 1)

        self.gram, self.beforehand, self.last = widened(self.gram), widened(self.beforehand), widened(self.last)
        self.whole = [widened(cluster) for cluster in self.whole]


class Correction(NamedTuple):
    """What frees an estimate of the bias that noise in the columns makes.

    shift (n,): to add to it. lost, uncertain (n, n): to add to its covariance, where rows say little for noise and for
    doubt about the shift.
    """

    shift: Array
    lost: Array
    uncertain: Array


def _beside_lost(
    directions: Array, along: Array, lost: Mask, attenuated: Array, beforehand: Array
) -> tuple[Array, Array]:
    """What changes where rows say little along directions: of the solution (k,) and its covariance (k, k).

    directions (n, k): of unit information, with the solution `along` (k,). attenuated: how many deviations of rows
    those that are lost to noise may be off. beforehand (n + 1, n + 1): the part of the normal equations that rows have
    not made.
    """
    if not lost.any():
        return np.zeros(along.size), np.zeros((along.size, along.size))
    own = directions.T @ beforehand[:-1, :-1] @ directions
    information, right = np.eye(along.size), along.copy()
    # Rows that say nothing along a direction do not tie it to others.
    information[lost] = own[lost]
    information[:, lost] = own[:, lost]
    rest = 1.0 / (1.0 + attenuated**2)
    information[lost, lost] += rest
    right[lost] = directions[:, lost].T @ beforehand[:-1, -1] + rest * along[lost]
    covariance = np.linalg.inv(information)
    return covariance @ right - along, covariance - np.eye(along.size)


def unbiased(
    estimate: Estimate, bias: NoiseBias, nuisances: Sequence[Nuisance] = (), lost_unknown: bool = False
) -> Estimate:
    """A least-squares estimate free of what noise in the columns does, and of contradicted tolerances of nuisances.

    Nuisances come first. One that was weighted against a prior keeps the bias. See `NoiseBias.correction`, `released`.
    """
    squares = estimate.covariance
    if estimate.scale is None:
        found = bias.correction(estimate.determined, lost_unknown)
        squares = squares + found.lost
        estimate = replace(estimate, pi=estimate.pi + found.shift, covariance=squares + found.uncertain)
    return released(estimate, nuisances, squares)
