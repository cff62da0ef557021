"""Values behind the first weights of a session, from fits of the windows that were held back till then.

First without weights and then with those of the fit before. A start that is 70 % off gives the same answer. With many
parameters such a fit may leave more than noise. Then it starts from the described values, and these stay in the weights
until the rows determine better ones. Where that leaves more than noise too, the model lacks something, and the weights
come from the fit of `criterion`, which does not shrink the parameters to zero.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sms_online.pipeline.criterion import Columns, minimum
from sms_online.pipeline.plain_rows import PlainRows
from sms_online.pipeline.prior_information import PriorInformation
from sms_online.pipeline.row_grams import RowGrams
from sms_online.pipeline.white_rows import WhiteRows
from sms_online.stream import Array, Mask

# Weighted fits of the windows held back before their rows are handed on.
PASSES = 2
# The same from described values. A second one would follow what noise in the columns does to few windows.
PASSES_DESCRIBED = 1
# A fit of few windows determines a parameter that is so many standard deviations from zero.
DETERMINED = 3.0
# Singular values below this share of the largest, of columns scaled to unit length, are not solved for.
RANK_TOLERANCE = 1e-10

# Whitens the windows held back with weights (n,), and has sums of plain rows follow.
Whiten = Callable[[Array], list[WhiteRows]]


class FirstWeights:
    """Finds β (n,) for m nuisances and n parameters.

    nominal (n,): described values. calibration (k, m + n + 1), columns, prior_information: as in `MomentumFit`.
    torque, gained (n_v,): which speeds' rows hold a torque, and which one whose gain is a parameter.
    """

    def __init__(
        self,
        nominal: Array,
        calibration: Array,
        columns: Columns,
        torque: Mask,
        gained: Mask,
        prior_information: Callable[[], PriorInformation],
    ) -> None:
        self._nominal, self._calibration = nominal, calibration
        self._columns, self._prior_information = columns, prior_information
        self._torque, self._gained = torque, gained
        self._nuisances = calibration.shape[1] - nominal.size - 1

    def of(self, held: Array, plain: PlainRows, whiten: Whiten) -> Array:
        """β (n,) of windows' rows [Y b] (W, copies, n_v, n + 1); plain: sums that `whiten` makes of them anew."""
        unweighted, _ = _least_squares(np.concatenate(held[:, 0]))
        if self._gained.any():
            return self._scale_free(held, plain, whiten, [self._nominal, unweighted])
        weights, excess = self._iterated(unweighted, plain, whiten, PASSES, partly=False)
        if excess.any():
            misfit = plain.misfit
            described, other = self._iterated(self._nominal, plain, whiten, PASSES_DESCRIBED, partly=True)
            if other.sum() < excess.sum():
                weights = described
            if plain.misfit.any() and misfit.any():
                weights = self._scale_free(held, plain, whiten, [unweighted, self._nominal])
        return weights

    def _iterated(
        self, weights: Array, plain: PlainRows, whiten: Whiten, passes: int, partly: bool
    ) -> tuple[Array, Array]:
        """β (n,) of fits with weights of the fit before, and what the last leaves over noise (n_v,).

        weights: of the first fit. partly: they take what the rows determine, and keep the rest. A drift may be behind
        what is left while `plain` is patient, but not behind parameters that few rows have shrunk.
        """
        plain.misfit = np.zeros_like(plain.misfit)
        for _ in range(passes):
            white = [rows.Y for rows in whiten(weights)]
            white += [self._calibration] if len(self._calibration) else []
            fitted, determined = _least_squares(np.concatenate(white))
            beta, known = fitted[self._nuisances :], determined[self._nuisances :]
            plain.judge(fitted)
            weights = np.where(known, beta, weights) if partly else beta
        return weights, plain.excess(fitted)

    def _scale_free(self, held: Array, plain: PlainRows, whiten: Whiten, starts: list[Array]) -> Array:
        """β (n,) of fits by `criterion`, first of the rows as they are.

        Weights that follow a least-squares fit of rows that hold more than noise would shrink π to zero.
        """
        n_v, m = held.shape[2], self._nuisances
        grams = RowGrams.none(n_v, self._nominal.size, m)
        for rows in held:
            padded = np.pad(rows, ((0, 0), (0, 0), (m, 0)))
            grams.add(padded[0], padded[1:])
        lacking = np.ones(n_v, dtype=np.bool_)
        starts = [np.pad(start, (m, 0)) for start in starts]
        for _ in range(PASSES):
            joint = self._least(grams, lacking, starts)
            # What the rows leave of the new weights' noise, and the rows whitened with it.
            for _ in range(2):
                white = whiten(joint[m:])
                plain.judge(joint)
            grams = RowGrams.none(n_v, self._nominal.size, m, self._columns.multiplying)
            for each in white:
                grams.add(each.Y, each.noisy, each.multiplied)
            lacking, starts = (plain.misfit > 0.0) | self._gained, [joint]
        return self._least(grams, lacking, starts)[m:]

    def _least(self, grams: RowGrams, lacking: Mask, starts: list[Array]) -> Array:
        """Nuisances and β (m + n,) of the minimum as far as the rows determine them, else the described values.

        Noise that follows a parameter which rows do not determine may be any.
        """
        found = minimum(grams, lacking, self._torque, starts, self._columns, self._prior_information())
        determined = np.abs(found.beta) > DETERMINED * np.sqrt(np.diag(found.covariance))
        determined[: self._nuisances] = True
        return np.where(determined, found.beta, np.pad(self._nominal, (self._nuisances, 0)))


def _least_squares(rows: Array) -> tuple[Array, Mask]:
    """Least-squares solution (n,) of rows [Y b] (M, n + 1) of unit variance, and where they determine it.

    Of minimum norm in units of the columns' sizes.
    """
    size = np.linalg.norm(rows, axis=0)
    scale = np.where(size[:-1] > 0.0, size[:-1], 1.0)
    U, S, Vt = np.linalg.svd(rows[:, :-1] / scale, full_matrices=False)
    known = RANK_TOLERANCE * S[0] < S
    solution = Vt[known].T @ ((U[:, known].T @ rows[:, -1]) / S[known])
    spread = np.linalg.norm(Vt.T / np.maximum(S, RANK_TOLERANCE * S[0]), axis=1)
    return solution / scale, np.abs(solution) > DETERMINED * spread
