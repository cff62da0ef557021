"""An estimate that does not change when rows without a torque are scaled: for rows that leave more than noise.

Rows of links and base hold no torque: they are homogeneous in π, and so is what noise makes of them. Least squares,
weighted anew with the noise that π itself predicts, lowers their residual by shrinking π wherever they hold more than
noise; the weights follow, and it ends at zero. With w = (π, -1), A the Gram matrix of a row type's whitened rows [Y b]
and G that of what sensors' noise adds to them, the estimate is the minimum of

    Σ n/2 log(wᵀ A w / wᵀ (G + e² M) w) + Σ n/2 wᵀ A w / (ρ wᵀ G w),

the first sum over the types that leave more than noise, the second over the others. The quotient of a homogeneous type
is the same for every scale of π, so nothing draws π to zero, and only rows with a torque fix its scale. e² M is what
the model lacks beside noise: an error of each force in proportion to its size, the same share e of all of them. M is
the diagonal of A - G, but for the inertial forces, which count as one: they may nearly cancel each other, and then the
error of their sum is as small. e follows from the residual. G in the denominators also frees the minimum of what noise
in the columns does to least squares. Of rows that hold a joint's torque all error counts as that of the torque, and no
G is in their denominators: along columns that are little more than noise, which nothing else determines, these would
grow as fast as the residual, and π without end. ρ makes the variance of whitened rows one at the weights' own π,
whatever else these hold as noise.

What is known beside the rows enters as `prior_information` says.

Reading: the concentrated likelihood of the functional errors-in-variables model, one variance factor a row type.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from sms_online.pipeline.gram_sum import ROUNDED
from sms_online.pipeline.momentum_windows import OVERLAP
from sms_online.pipeline.prior_information import WIDENED, Penalty, PriorInformation
from sms_online.pipeline.row_grams import RowGrams
from sms_online.stream import Array, Mask

# Directions of scaled columns with less information than this share of the largest are rounding, and not moved along.
# Where one joint's torque alone fixes the scale and its rows leave much, they say 1e-10 of what other rows do, or less.
RANK_TOLERANCE = 1e-13
# Half the square of the Newton step in standard deviations at which the minimum is found, and steps at most.
CONVERGED, MOST_STEPS = 1e-6, 100
# Newton's step is taken where the criterion's curvature is no less than this share of that of its squares.
LEAST_CURVATURE = 1e-2
# Noise in whitened rows below this share of their variance is none: their weights follow from the rest of it.
LEAST_NOISE = 0.1
# A step is halved until it gains this share of what the slope promises, so many times at most.
SUFFICIENT, HALVINGS = 1e-4, 30


@dataclass(frozen=True)
class Columns:
    """What the columns [N Y b] of rows belong to. nuisances: how many columns N has. gains: which are torques' gains.

    inertial (m + n,): which are of inertial parameters. multiplying: which multiply noise, see `multiplied_noise`.
    """

    nuisances: int
    gains: tuple[int, ...]
    inertial: Mask
    multiplying: tuple[int, ...] = ()

    def sharing(self, torque: bool) -> Mask:
        """Which columns (m + n + 1,) of rows with a torque, or of others, share their error.

        All inertial forces follow from the same accelerations, and may cancel each other. Where a torque is, it is all
        that is wrong, with its gain.
        """
        if not torque:
            return np.append(self.inertial, False)
        own = np.zeros(self.inertial.size + 1, dtype=np.bool_)
        own[[*self.gains, -1]] = True
        return own

    @property
    def apart(self) -> Mask:
        """Which (m + n + 1,) have an error of their own in rows without a torque. Nuisances have none."""
        forces = np.arange(self.inertial.size + 1) >= self.nuisances
        return np.asarray(forces & ~self.sharing(torque=False))

    def same(self, torque: bool) -> Mask:
        """Which pairs (m + n + 1, m + n + 1) have the same error."""
        sharing = self.sharing(torque)
        pairs = np.outer(sharing, sharing)
        return pairs if torque else pairs | np.diag(self.apart)


@dataclass(frozen=True)
class Minimum:
    """The least value of the criterion, and how it rises from there.

    beta (n,): where it is. directions (n, rank): of unit curvature, those with information. slopes
    (n_v, n): of each speed's part of it, which add up to what priors pull with.
    """

    beta: Array
    directions: Array
    slopes: Array

    @property
    def covariance(self) -> Array:
        """Inverse (n, n) of the curvature, rows as independent as they count; of other directions zero."""
        return self.directions @ self.directions.T


@dataclass(frozen=True)
class _Point:
    """w (m + n + 1,) and its products with the matrices of a criterion: linear in w."""

    w: Array
    A: Array
    G: Array
    M: Array

    def moved(self, step: _Point, length: float) -> _Point:
        """By so much of a step."""
        own = (self.w, self.A, self.G, self.M)
        along = (step.w, step.A, step.G, step.M)
        return _Point(*(one + length * other for one, other in zip(own, along, strict=True)))


class Criterion:
    """The criterion of some rows. lacking, torque (n_v,): which leave more than noise, and which hold a torque.

    lasting (n_v,): factor by which errors that last from window to window widen the variance of what a speed's rows
    say, see `lasting_errors`; one by default. Of the matrices only those are kept that some row needs: they are read
    once for a step, which is what it costs.
    """

    def __init__(
        self,
        grams: RowGrams,
        lacking: Mask,
        torque: Mask,
        columns: Columns,
        start: Array,
        lasting: Array | None = None,
    ) -> None:
        signal, of_noise = grams.signal.matrices, grams.noise.matrices
        self._A, self._lacking = signal, lacking
        self._torque, self._columns = torque, columns
        self._squares = np.einsum("vii->vi", signal)
        self._count = np.where(lacking, grams.windows / OVERLAP, float(grams.windows))
        if lasting is not None:
            self._count = self._count / lasting
        m = grams.nuisances
        self._noisy_columns = slice(m, None)
        # What the model lacks is an error of these columns.
        self._wrong = np.flatnonzero(columns.sharing(torque=True) | columns.sharing(torque=False) | columns.apart)
        pairs = np.ix_(self._wrong, self._wrong)
        kinds = np.array([columns.same(torque=kind)[pairs] for kind in (False, True)])
        beyond = signal[lacking]
        beyond[:, m:, m:] -= of_noise[lacking]
        beyond = beyond[:, self._wrong[:, None], self._wrong]
        self._M = np.where(kinds[torque[lacking].astype(int)], beyond, 0.0)
        diagonal = np.einsum("vii->vi", self._M)
        diagonal[:] = np.maximum(diagonal, 0.0)
        # Rows without noise have a constant deviation: one.
        noise = of_noise @ start[m:] @ start[m:]
        noisy = ~lacking & ~torque & (noise > grams.windows * LEAST_NOISE)
        scale = np.where(noisy, grams.windows / np.where(noisy, noise, 1.0), np.where(lacking & ~torque, 1.0, 0.0))
        self._constant = np.where(lacking | noisy, 0.0, float(grams.windows))
        self._noisy = scale > 0.0
        self._G = scale[self._noisy, None, None] * of_noise[self._noisy]

    def at(self, w: Array) -> _Point:
        """w (m + n + 1,) with its products."""
        of_noise, of_lack = w[self._noisy_columns], w[self._wrong]
        return _Point(w, self._A @ w, self._G @ of_noise, self._M @ of_lack)

    def _noise(self, at: _Point) -> Array:
        """Sums of squares (n_v,) of what noise adds to the residual, where they are counted."""
        return self._spread(at.G @ at.w[self._noisy_columns], self._noisy)

    def _lack(self, at: _Point) -> Array:
        """Sums of squares (n_v,) of the columns that the model may lack a share of."""
        return self._spread(at.M @ at.w[self._wrong], self._lacking)

    def _spread(self, values: Array, rows: Mask) -> Array:
        """Values of some rows (·, …) among zeros of all (n_v, …)."""
        out = np.zeros((rows.size, *values.shape[1:]))
        out[rows] = values
        return out

    def _least(self, w: Array) -> Array:
        """Rounding (n_v,) of such sums."""
        size = self._squares @ w**2
        return np.asarray(ROUNDED * np.finfo(np.float64).eps * size + np.finfo(np.float64).tiny)

    def squares(self, at: _Point) -> Array:
        """Sums of squares (n_v,) of the residual."""
        return np.asarray(np.maximum(at.A @ at.w, self._least(at.w)))

    def errors(self, at: _Point) -> Array:
        """e² (n_v,) that explains what the residual holds beyond noise."""
        beyond = np.maximum(self.squares(at) - self._noise(at), 0.0)
        size = np.maximum(self._lack(at), self._least(at.w))
        return np.where(self._lacking, beyond / size, 0.0)

    def predicted(self, at: _Point, errors: Array) -> Array:
        """Expected sums of squares (n_v,)."""
        of_model = errors * self._lack(at)
        noise = self._noise(at) + of_model + self._constant
        return np.asarray(np.maximum(noise, self._least(at.w)))

    def value(self, at: _Point, errors: Array) -> float:
        """Value of the criterion, with e² (n_v,) given."""
        ratio = self.squares(at) / self.predicted(at, errors)
        each = np.where(self._lacking, np.log(ratio), ratio)
        return 0.5 * float(self._count @ each)

    def relative(self, w: Array, nuisances: int) -> float:
        """Sum of the logarithms of the residuals' shares of their rows, by which different starts compare.

        Columns of nuisances are left out of the rows' size: they may be large and cancel.
        """
        share = self.squares(self.at(w)) / (self._squares[:, nuisances:] @ w[nuisances:] ** 2)
        return 0.5 * float(self._count @ np.log(share))

    def slopes(self, at: _Point, errors: Array) -> tuple[Array, Array, Array]:
        """By speed: slopes (n_v, n + 1), curvature of the squares and of the whole (n + 1, n + 1)."""
        S, D, n = self.squares(at), self.predicted(at, errors), self._count
        a, g = at.A, np.zeros_like(at.A)
        g[self._noisy, self._noisy_columns] = at.G
        g[np.ix_(self._lacking, self._wrong)] += errors[self._lacking, None] * at.M
        inside = np.where(self._lacking, n / S, n / D)  # weight of the squares
        outside = np.where(self._lacking, n / D, n * S / D**2)  # and of what is expected
        slopes = inside[:, None] * a - outside[:, None] * g
        squares = np.tensordot(inside, self._A, 1)
        whole = squares.copy()
        whole[self._noisy_columns, self._noisy_columns] -= np.tensordot(outside[self._noisy], self._G, 1)
        whole[np.ix_(self._wrong, self._wrong)] -= np.tensordot((outside * errors)[self._lacking], self._M, 1)
        log, plain = np.where(self._lacking, n, 0.0), np.where(self._lacking, 0.0, n)
        whole += (-2.0 * log / S**2 * a.T) @ a
        cross = (-2.0 * plain / D**2 * a.T) @ g
        whole += ((2.0 * log / D**2 + 4.0 * plain * S / D**3) * g.T) @ g + cross + cross.T
        return slopes, squares, whole

    def lasting_errors(self, grams: RowGrams, found: Minimum, before: Array) -> Array:
        """Factor (n_v,) by which errors that last widen the variance of what rows say, at a minimum; one at least.

        Slopes of blocks of time scatter by as much as curvature says where errors are independent. Either counts in the
        metric of all curvature, so directions that others determine count little. before (n_v,): the factors so far.
        """
        out, count = before.copy(), len(grams.marks)
        if count < 2:
            return out
        w = np.append(found.beta, -1.0)
        at = self.at(w)
        errors = self.errors(at)[self._lacking, None]
        S, D, n = (v[self._lacking] for v in (self.squares(at), self.predicted(at, self.errors(at)), self._count))
        of_rows, of_model = grams.block_products(w)[0][:, self._lacking], self._lack_of_blocks(grams, w)
        slopes = (n / S)[:, None] * of_rows - (n / D)[:, None] * errors * of_model
        scattered = (slopes - slopes.mean(axis=0))[..., :-1] @ found.directions
        scatter = count / (count - 1) * np.sum(scattered**2, axis=(0, 2))
        curvature = self._A[self._lacking][:, :-1, :-1] @ found.directions
        expected = n / S * np.einsum("kr,vkr->v", found.directions, curvature)
        share = np.divide(scatter, expected, out=np.ones_like(scatter), where=expected > 0.0)
        out[self._lacking] = np.maximum(1.0, before[self._lacking] * share)
        return out

    def _lack_of_blocks(self, grams: RowGrams, w: Array) -> Array:
        """Products (blocks, lacking rows, m + n + 1) of the matrices M of each block of time with w."""
        columns, torque, m = self._columns, self._torque[:, None], grams.nuisances
        signal, noise = grams.block_diagonals()
        signal[..., m:] -= noise
        out = np.where(~torque & columns.apart, signal * w, 0.0)
        for kind in (True, False):
            sharing = columns.sharing(kind)
            signal, noise = grams.block_products(np.where(sharing, w, 0.0))
            signal[..., m:] -= noise
            out += np.where((torque == kind) & sharing, signal, 0.0)
        return np.asarray(out[:, self._lacking])


def minimum(
    grams: RowGrams,
    lacking: Mask,
    torque: Mask,
    starts: list[Array],
    columns: Columns,
    known: PriorInformation,
) -> Minimum:
    """The minimum of the criterion that is lowest of those next to some starts β (n,).

    lacking, torque (n_v,): which speeds' rows leave more than noise, and which hold a torque. The first start holds the
    weights behind the rows. known: what is known of β beside the rows.
    """
    w = np.append(starts[0], -1.0)
    criterion = Criterion(grams, lacking, torque, columns, w)
    squares = np.einsum("vii->vi", grams.signal.matrices)
    penalties = [Penalty(known, columns.nuisances, squares, w, widened) for widened in WIDENED]
    penalty = penalties[-1]
    found = [descended(criterion, np.append(start, -1.0), penalty) for start in starts]
    if len(known.doubtful):
        freed = found[0]
        for wider in penalties:
            freed = descended(criterion, freed, wider)
        found.append(freed)
    best = min(found, key=lambda each: criterion.relative(each, columns.nuisances) + penalty.value(each))
    return at_minimum(criterion, best, penalty)


def at_minimum(criterion: Criterion, w: Array, penalty: Penalty) -> Minimum:
    """What there is to know of the minimum at w (n + 1,)."""
    there = criterion.at(w)
    slopes, curvature, _ = criterion.slopes(there, criterion.errors(there))
    directions = _basis(curvature[:-1, :-1] + penalty.derivatives(w)[1])
    return Minimum(w[:-1], directions, slopes[:, :-1])


def _basis(information: Array) -> Array:
    """Directions (n, rank) of unit information."""
    scale = _unit_scale(information)
    scaled = information * np.outer(scale, scale)
    # No eigenvalue is above n, so that none is to be left out here; eigenvectors take twenty times as long.
    if _all_above(scaled, RANK_TOLERANCE * scale.size * np.eye(scale.size)):
        inverse = solve_triangular(np.linalg.cholesky(scaled), np.eye(scale.size), lower=True)
        return np.asarray(scale[:, None] * inverse.T)
    values, vectors = np.linalg.eigh(scaled)
    kept = values > RANK_TOLERANCE * values[-1]
    return np.asarray(scale[:, None] * vectors[:, kept] / np.sqrt(values[kept]))


def _unit_scale(information: Array) -> Array:
    """Scale (n,) of parameters that makes their own information one, zero where they have none."""
    size = np.sqrt(np.maximum(np.diag(information), 0.0))
    return np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)


def _newton_step(information: Array, curvature: Array, slope: Array) -> Array:
    """Step (n,) downhill where there is information: Newton's, or one of the squares where the criterion is concave.

    The latter is a step of iteratively reweighted least squares, which goes on where Newton's would have to be halved.
    """
    scale = _unit_scale(information)
    both = np.outer(scale, scale)
    scaled, curved = information * both, curvature * both
    if _all_above(scaled, RANK_TOLERANCE * scale.size * np.eye(scale.size)):
        used = curved if _all_above(curved, LEAST_CURVATURE * scaled) else scaled
        return np.asarray(scale * cho_solve(cho_factor(used, lower=True), -scale * slope))
    directions = _basis(information)
    values, vectors = np.linalg.eigh(directions.T @ curvature @ directions)
    axes = directions @ vectors
    return np.asarray(-axes @ ((axes.T @ slope) / (values if values[0] > LEAST_CURVATURE else 1.0)))


def _all_above(matrix: Array, least: Array) -> bool:
    """Whether a symmetric matrix (n, n) is above another in every direction."""
    try:
        np.linalg.cholesky(matrix - least)
    except np.linalg.LinAlgError:
        return False
    return True


def descended(criterion: Criterion, w: Array, penalty: Penalty) -> Array:
    """Newton steps from w; e follows from step to step."""
    at = criterion.at(w)
    for _ in range(MOST_STEPS):
        errors = criterion.errors(at)
        slopes, squares, whole = criterion.slopes(at, errors)
        pull, known = penalty.derivatives(at.w)
        slope = slopes.sum(axis=0)[:-1] + pull
        step = _newton_step(squares[:-1, :-1] + known, whole[:-1, :-1] + known, slope)
        gain = -float(slope @ step)
        if gain < CONVERGED:
            break
        before, length = criterion.value(at, errors) + penalty.value(at.w), 1.0
        along = criterion.at(np.append(step, 0.0))
        for _ in range(HALVINGS):
            moved = at.moved(along, length)
            if criterion.value(moved, errors) + penalty.value(moved.w) <= before - SUFFICIENT * length * gain:
                break
            length *= 0.5
        else:
            break
        at = moved
    return at.w
