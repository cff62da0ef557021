"""A session's estimate by the criterion that no scale of the rows changes, with error bars from blocks of time.

What the model lacks is alike from window to window for as long as it likes. The rows' squares as curvature H take rows
for as independent as windows overlap. So beside priors each speed's rows are divided by a factor: by how much more the
slopes of blocks of time scatter than that curvature says. They then weigh what they are worth. One factor is a mean
over all directions, and noise in columns counts as information in H. So each block of time is left out in turn as well:
with δ_c from the minimum of all to that of the others, the covariance is (C - 1)/C Σ (δ_c - δ̄) (δ_c - δ̄)ᵀ + H⁻¹ P H⁻¹,
P the curvature of what is known beside the rows. To first order that is the sandwich H⁻¹ J H⁻¹ with J from blocks, in
which each score counts by what the others say where it was: a parameter that one block determines nearly alone gets the
bar that the others leave it. Blocks are as long as a session allows, so they are few, and the deviations are those of
Student's t.

Sources: Ribatet, Cooley and Davison, Statistica Sinica 22 (2012) 813 (a composite likelihood beside a prior, by one
factor to its logarithm); Künsch, Annals of Statistics 17 (1989) 1217 (jackknife of blocks of time); MacKinnon, Nielsen
and Webb, J. Applied Econometrics 38 (2023) 671 (it against other sandwiches); Bester, Conley and Hansen, J.
Econometrics 165 (2011) 137 (few long blocks and Student's t).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import stdtrit

from sms_online.pipeline.criterion import Columns, Criterion, Minimum, at_minimum, descended, minimum
from sms_online.pipeline.prior_information import Penalty, PriorInformation
from sms_online.pipeline.row_grams import RowGrams
from sms_online.stream import Array, Mask
from sms_online.trackers.factor import masked_covariance
from sms_online.trackers.interface import Estimate

# Factors and minimum follow each other, so many times: by then factors move by hundredths.
PASSES = 3
# Probability by Student's distribution at which deviations are compared: two of a normal one.
TWO_DEVIATIONS = 0.97725
# What the others determine by less than this share, a block determines alone. A share below the second is rounding.
LEAST_LEFT, LOST = 1e-2, 1e-10


@dataclass(frozen=True)
class ScaleFree:
    """What the criterion needs of a session's rows; see `minimum`. weights (n,): values behind the rows' whitening.

    alone: nothing is known of π beside the rows.
    """

    grams: RowGrams
    lacking: Mask
    torque: Mask
    weights: Array
    columns: Columns
    known: PriorInformation
    alone: bool
    _robust: dict[bytes, Array] = field(default_factory=dict, init=False, repr=False, compare=False)

    def minimum(self) -> Minimum:
        """The minimum next to the weights, rows counting as independent as their blocks of time show them to be."""
        return self._found[0]

    @property
    def lasting(self) -> Array:
        """Factor (n_v,) by which errors that last from window to window widen what rows say; one without priors."""
        return self._found[1]

    def solved(self, squares: Estimate) -> Estimate:
        """That minimum; squares: the estimate by least squares, which says what the rows determine.

        Its covariance is the inverse of the curvature there.
        """
        return self._solved(self.minimum(), squares)

    def estimate(self, squares: Estimate) -> Estimate:
        """The same with a robust covariance from blocks of time, which takes three times as long."""
        known = squares.determined
        robust = self._robust.get(known.tobytes())
        if robust is None:
            robust = self._robust[known.tobytes()] = self._of_blocks(known)
        return replace(self._solved(self.minimum(), squares), covariance_robust=robust)

    @cached_property
    def _found(self) -> tuple[Minimum, Array]:
        """See `minimum` and `lasting`, which follow each other."""
        found = minimum(self.grams, self.lacking, self.torque, [self.weights], self.columns, self.known)
        lasting = np.ones(self.lacking.size)
        for _ in range(0 if self.alone else PASSES):
            lasting = self._criterion(self.grams, lasting).lasting_errors(self.grams, found, lasting)
            criterion = self._criterion(self.grams, lasting)
            w = descended(criterion, np.append(found.beta, -1.0), self._penalty)
            found = at_minimum(criterion, w, self._penalty)
        return found, lasting

    def _criterion(self, grams: RowGrams, lasting: Array) -> Criterion:
        start = np.append(self.weights, -1.0)
        return Criterion(grams, self.lacking, self.torque, self.columns, start, lasting)

    @cached_property
    def _penalty(self) -> Penalty:
        squares = np.einsum("vii->vi", self.grams.signal.matrices)
        return Penalty(self.known, self.columns.nuisances, squares, np.append(self.weights, -1.0))

    def _solved(self, found: Minimum, squares: Estimate) -> Estimate:
        known = squares.determined
        return replace(
            squares,
            pi=np.where(known, found.beta, squares.pi),
            covariance=masked_covariance(found.covariance, known),
            covariance_robust=None,
            rss=squares.dof,
            scale=None if self.alone else 1.0,
        )

    def _of_blocks(self, known: Mask) -> Array:
        """Covariance (n, n) of the minimum from what it is without each block of time; known (n,): what has one.

        Infinite where blocks are fewer than two, and where one alone determines a parameter.
        """
        found, lasting = self._found
        covariance = found.covariance
        count, w = len(self.grams.marks), np.append(found.beta, -1.0)
        if count < 2:
            return masked_covariance(covariance, np.zeros_like(known))
        beforehand = self._penalty.derivatives(w)[1]
        fits = []
        for grams in self.grams.without_blocks():
            criterion = self._criterion(grams, lasting)
            at = criterion.at(w)
            curvature = criterion.slopes(at, criterion.errors(at))[1][:-1, :-1] + beforehand
            share, axes = np.linalg.eigh(found.directions.T @ curvature @ found.directions)
            left = np.sum((found.directions @ axes) ** 2 / np.maximum(share, LOST), axis=1)
            known = known & (LEAST_LEFT * left <= np.diag(covariance))
            fits.append(descended(criterion, w, self._penalty)[:-1])
        apart = np.array(fits) - np.mean(fits, axis=0)
        wider = (0.5 * float(stdtrit(count - 1, TWO_DEVIATIONS))) ** 2 * (count - 1) / count
        return masked_covariance(wider * (apart.T @ apart) + covariance @ beforehand @ covariance, known)
