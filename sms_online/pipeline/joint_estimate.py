"""Nuisances and parameters together, from a session's white rows.

Least squares free of what noise in the columns does, beside the tolerances; where rows leave more than noise, the
criterion that does not shrink the parameters to zero.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.calibration.nuisance import Nuisance, bound_rows, known_beforehand, prior_rows
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.errors_in_variables import NoiseBias, unbiased
from sms_online.pipeline.momentum_fit import MomentumFit
from sms_online.pipeline.prior_information import PriorInformation
from sms_online.pipeline.row_grams import RowGrams
from sms_online.pipeline.scale_free import ScaleFree
from sms_online.pipeline.torque_gains import plausible_gains
from sms_online.pipeline.white_rows import WhiteRows
from sms_online.state import Stage, State, state_copy
from sms_online.stream import Array
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Estimate, Prior, Rows, Tracker, prior_factor
from sms_online.trackers.square_root import session_tracker


class JointEstimateState(State):
    """What a joint estimate keeps beside its sums.

    known (k, m + n + 1): what is known from before an event, as rows [N Y b] of unit variance. misfit (n_v,): behind
    the rows that came last; weights (n,): likewise, None before the first.
    """

    known: Array
    misfit: Array
    weights: Array | None = None


class JointEstimate(Stage):
    """Sums of one session's rows [N Y b], from one event to the next.

    multiplying: nuisances that multiply noise. prior: of the parameters, None where there is none; within: what the
    estimate goes on from holds it. tracker: fed with rows of unit variance, all of which count alike. bias: what noise
    in the columns does to its estimate. grams: sums of rows by generalized speed, for an estimate where they leave more
    than noise.
    """

    def __init__(
        self,
        model: Model,
        base: BaseParameters,
        nuisances: Sequence[Nuisance],
        multiplying: Sequence[int],
        prior: Prior | None,
        within: bool = False,
    ) -> None:
        self._nuisances, self._prior, self._within = tuple(nuisances), prior, within
        self._n, self._n_v, self._multiplying = base.n, model.layout.n_v, tuple(multiplying)
        self._calibration = prior_rows(self._nuisances, base.n)
        self._gains = plausible_gains(model, base, len(self._nuisances))
        self.tracker: Tracker = session_tracker(base.n, prior, len(self._nuisances), within)
        if self._nuisances:
            self.tracker.begin(known_beforehand(self._nuisances, base.n))
        self.bias, self.grams = self._new_sums()
        self.earlier = self._new_sums()[0]
        self._kept: ScaleFree | None = None  # of the rows so far
        self.state = JointEstimateState(np.zeros((0, len(self._nuisances) + base.n + 1)), np.zeros(self._n_v))

    def _new_sums(self) -> tuple[NoiseBias, RowGrams]:
        m = len(self._nuisances)
        bias = NoiseBias.none(m + self._n, self._calibration, self._multiplying)
        return bias, RowGrams.none(self._n_v, self._n, m, self._multiplying)

    def begin_behind_event(self, known: Information, bias: NoiseBias) -> None:
        """Go on with what is known from before an event, and what noise in the columns did by then."""
        self._kept = None
        bias.widen(len(self._nuisances) + self._n - bias.parameters)
        self.bias, self.earlier, self.state.known = bias, state_copy(bias), known.factor
        self.tracker.begin(known)

    def begin_drift(self, known: Information) -> None:
        """Forget what took parameters for constant, and go on from what is known, priors within."""
        self._kept = None
        # What rows before an event did stays: they alone may know parameters apart, as a link and a payload on it.
        self.bias, self.grams = state_copy(self.earlier), self._new_sums()[1]
        self.state.known, self._within = known.factor, True
        self.tracker = session_tracker(self._n, self._prior, len(self._nuisances), within=True)
        self.tracker.begin(known)

    def add(self, rows: WhiteRows, t: float) -> None:
        """Take in the rows of a window that ends at t, s."""
        self._kept, M = None, rows.Y.shape[0]
        self.tracker.update(Rows(rows.Y[:, :-1], rows.Y[:, -1], np.ones(M), np.full(M, t)))
        self.bias.add(rows.Y, rows.noisy, rows.multiplied)
        now, before = self.state, self.state.weights
        if before is None or np.any(rows.misfit != now.misfit) or np.any(rows.weights != before):
            if before is not None:
                self.grams.whiten_anew((before, now.misfit), (rows.weights, rows.misfit))
            now.weights, now.misfit = rows.weights, rows.misfit
        self.grams.add(rows.Y, rows.noisy, rows.multiplied)

    def estimate(self, fit: MomentumFit) -> Estimate:
        """The nuisances, then the base parameters; fit: that the rows come from."""
        squares, scale_free = self.tracker.estimate(), self.scale_free(fit)
        return self._unbiased(squares) if scale_free is None else scale_free.estimate(squares)

    def solved(self, fit: MomentumFit, lost_unknown: bool = False) -> Estimate:
        """The same without what only error bars take.

        lost_unknown: whether nothing is known along directions whose information noise makes. Least squares attenuate
        there: weights that followed would predict less noise, so that the next estimate is attenuated further and looks
        better determined.
        """
        squares, scale_free = self.tracker.estimate(), self.scale_free(fit)
        return self._unbiased(squares, lost_unknown) if scale_free is None else scale_free.solved(squares)

    def _unbiased(self, squares: Estimate, lost_unknown: bool = False) -> Estimate:
        return unbiased(squares, self.bias, self._nuisances, lost_unknown)

    def row_variance(self, fit: MomentumFit) -> float:
        """Mean square of what the rows leave, in units of their predicted variance."""
        left = 1.0  # where rows are weighted by what they leave
        if self.scale_free(fit) is None:
            estimate = self.solved(fit)
            left = estimate.rss / max(estimate.dof, 1.0)
        return left * (1.0 + float(fit.plain.misfit.mean()))

    def scale_free(self, fit: MomentumFit) -> ScaleFree | None:
        """Where rows leave more than noise, what gives the estimate in place of least squares.

        The same until rows come, for its minimum and its covariance take time.
        """
        if not fit.lacking.any() or self.grams.windows == 0:
            return None
        assert fit.weights is not None
        weights = np.pad(fit.weights, (len(self._nuisances), 0))
        kept, lacking = self._kept, fit.lacking
        if kept is None or np.any(kept.lacking != lacking) or np.any(kept.weights != weights):
            known, unscaled = self.prior_information(), self._prior is None
            kept = ScaleFree(state_copy(self.grams), lacking, fit.torque, weights, fit.columns, known, unscaled)
            self._kept = kept
        return kept

    def prior_information(self) -> PriorInformation:
        """What is known of nuisances and parameters beside the rows; tolerances may be released, within bounds."""
        prior = None if self._within else self._prior
        known = np.pad(prior_factor(prior, self._n), ((0, 0), (len(self._nuisances), 0)))
        may = np.array([each.may_give_way for each in self._nuisances if np.isfinite(each.tolerance)], dtype=np.bool_)
        if len(self._gains):
            # They and a free gain could explain a torque between them.
            may[:] = False
        bounds = bound_rows(self._nuisances, self._n)
        certain = np.concatenate((self.state.known, self._calibration[~may], bounds, known, self._gains))
        return PriorInformation(certain, self._calibration[may])
