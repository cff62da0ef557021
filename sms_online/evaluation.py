"""Evaluation of a session's statistics: estimate, error bars and residuals, each on request.

A pure function of `Statistics`, so that the estimator's process, the view's and a reader of saved statistics say the
same. `verdict.judged` adds whether to trust it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from sms_online.calibration.found import Calibration, found
from sms_online.calibration.truncation import share_variance
from sms_online.effects.possible import not_negative
from sms_online.model.parameters import Parameter
from sms_online.nominal import NominalComparison, compare, unit_factors
from sms_online.physical import PhysicalSet, Projection
from sms_online.pipeline.description import described, nearer
from sms_online.pipeline.statistics import Statistics
from sms_online.pipeline.tracker_bank import Reading, rows_per_second
from sms_online.row_types import ENERGY, LARGEST_RESIDUAL, Residual, joint_rows, row_types
from sms_online.stream import Array, Mask
from sms_online.threads import one_blas_thread
from sms_online.tracker_results import Consistency, Drift, Tracked, TrackerResult
from sms_online.trackers.interface import Estimate, Prior

# Half width of a 95 % interval in standard deviations.
NORMAL_95 = 1.959963984540054
# An estimate within three standard deviations of zero is not determined by the data: not even its sign is certain.
LARGEST_RELATIVE_STD = 1.0 / 3.0
# Ratios of parameters are determined where those of this share of them are.
LEAST_RATIOS = 1.0 / 3.0
# Information that is less than this share of what it is a difference of is rounding.
ROUNDED = 1e-9
# Mean square of rows over their predicted variance that noise alone may leave: that of the noise is estimated to 7 %.
LARGEST_ROW_VARIANCE = 1.2
# Attenuation bias matters where it exceeds this many standard deviations of the estimate.
LARGEST_BIAS = 1.0


def identifiable(beta: Array, std: Array) -> Mask:
    """Which parameters β (n,) the data determine: std (n,) is finite, and β three of it from zero."""
    return np.asarray(std <= LARGEST_RELATIVE_STD * np.abs(beta))


def ratios_determined(beta: Array, covariance: Array) -> bool:
    """Whether many parameters β (n,) of a covariance (n, n) are `identifiable` once one of them is held."""
    variance = np.diag(covariance)
    # Of each parameter where one is held, column by column.
    std = np.sqrt(np.maximum(0.0, variance[:, None] - covariance**2 / variance))
    return bool(np.max(np.mean(identifiable(beta[:, None], std), axis=0)) > LEAST_RATIOS)


def beside_prior(estimate: Estimate, std: Array, prior: Prior) -> tuple[Array, Array]:
    """What is known of each parameter beside its own prior: value (n,), and 1σ (n,), inf where that is nothing.

    It is what, together with the prior, gives the posterior; `std` (n,), as it is reported, widens both alike.
    """
    value, out, known = estimate.pi.copy(), std.copy(), np.flatnonzero(prior.known)
    of_prior, of_both = prior.std[known] ** -2.0, estimate.std[known] ** -2.0
    rest = of_both - of_prior
    some = rest > ROUNDED * of_both
    less = known[~some]
    value[less], out[less] = 0.0, np.inf
    known, of_prior, of_both, rest = known[some], of_prior[some], of_both[some], rest[some]
    value[known] = (of_both * estimate.pi[known] - of_prior * prior.value[known]) / rest
    out[known] = std[known] * np.sqrt(of_both / rest)
    return value, out


def negative(names: Sequence[str], beta: Array, std: Array) -> list[str]:
    """Those of the names whose parameters β (n,) are negative beyond their 95 % interval and cannot be; std (n,)."""
    below = [name for name, upper in zip(names, beta + NORMAL_95 * std, strict=True) if upper < 0.0]
    return [name for name in below if not_negative(name)]


class Evaluation:
    """The statistics of an instant, evaluated.

    estimate: the one that follows from them, where it is at hand: to make it costs milliseconds.
    """

    def __init__(self, statistics: Statistics, estimate: Estimate | None = None) -> None:
        self.statistics = statistics
        self.model, self.base = statistics.setup.model, statistics.setup.base
        self._estimate = estimate

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What is estimated, (n,)."""
        return self.base.parameters

    @cached_property
    def estimate(self) -> Estimate:
        """The base parameters as the rows determine them."""
        return self.statistics.estimate() if self._estimate is None else self._estimate

    @cached_property
    @one_blas_thread()
    def std(self) -> Array:
        """1σ of each parameter (n,) as it is reported, inf where the data determine nothing.

        The smoother's covariance follows from the noise of sensors and torques, and of forces where it had to allow
        some; then it is no smaller than what blocks of spans scatter by, see `smoother.jackknife`. Rows of the momentum
        balance have a predicted variance. While the residual agrees with it, the estimate's covariance follows from it;
        where rows leave more, the model lacks something and the residual decides, as it does for rows of the energy
        balance.
        From the residual: the larger of two answers. One takes the rows' errors as independent with the residual's
        variance, the other allows errors that last within clusters of rows. To it comes what errors add that rows of an
        energy window share, which least squares absorbs and no residual shows; it is known while no row is forgotten.
        Where rows beside a prior leave no more than noise, the posterior's own covariance holds. In each case comes
        what the elements of links leave unknown, see `calibration.truncation`.
        """
        return self._reported(self.estimate)

    def _reported(self, estimate: Estimate) -> Array:
        """See `std`; of any tracker's estimate."""
        return np.hypot(self._of_rows(estimate), np.sqrt(share_variance(estimate, self.statistics.setup.nuisances)))

    def _of_rows(self, estimate: Estimate) -> Array:
        now = self.statistics
        std = np.full(estimate.pi.shape, np.inf)
        if estimate.dof <= 0.0:
            return std
        known = estimate.determined
        misfit = self._misfit
        if now.method == "smoother" or (estimate.scale is not None and not misfit):
            std[known] = estimate.std[known]
            if now.method == "smoother" and estimate.covariance_robust is not None:
                std[known] = np.maximum(std, np.sqrt(np.diag(estimate.covariance_robust)))[known]
            return std
        row_variance = estimate.rss / estimate.dof
        if now.method == "momentum" and row_variance <= LARGEST_ROW_VARIANCE and not misfit:
            std[known] = estimate.std[known]
            return std
        variance = np.diag(estimate.covariance)[known] * row_variance
        if estimate.covariance_robust is not None:
            variance = np.maximum(variance, np.diag(estimate.covariance_robust)[known])
        if now.method == "energy" and estimate.rows == now.shared.rows:
            inverse = np.where(np.outer(known, known), estimate.covariance, 0.0)
            variance = variance + now.shared.variance(inverse, row_variance)[known]
        std[known] = np.sqrt(variance)
        return std

    @property
    def _misfit(self) -> bool:
        """Whether rows of the balance that gives the estimate leave more than noise."""
        now = self.statistics
        return now.method == "momentum" and now.momentum is not None and bool(now.momentum.rows.misfit.any())

    @cached_property
    def determined(self) -> Mask:
        """Which parameters the data determine (n,), see `identifiable`: by themselves too, beside a stated value.

        None where nothing of the torques is explained.
        """
        return self._determined(self.estimate, self.std)

    def _determined(self, estimate: Estimate, std: Array) -> Mask:
        """See `determined`; of any tracker's estimate."""
        out, prior = identifiable(estimate.pi, std), self.statistics.setup.current_prior
        if self.explains_nothing:
            return np.zeros_like(out)
        # What an earlier run has measured, with its correlation, are data too.
        if prior is None or prior.correlation is not None:
            return out
        return out & identifiable(*beside_prior(estimate, std, prior))

    @cached_property
    def scale_alone(self) -> bool:
        """Whether no parameter is determined for want of the scale, see `ratios_determined`."""
        estimate, known = self.estimate, np.flatnonzero(np.isfinite(self.std) & self.estimate.determined)
        if self.determined.any() or self.explains_nothing or not known.size:
            return False
        return ratios_determined(estimate.pi[known], estimate.covariance[np.ix_(known, known)])

    @property
    def explains_nothing(self) -> bool:
        """Whether the estimate leaves most of every joint's torque, as noise or for another reason.

        Where the model lacks an effect, it is far from any that the error bars know of. Where noise is all that there
        is, error bars rest on the noise's size alone, which is not known that well.
        """
        shares = [each.relative for each in self.residuals.values() if each.relative is not None]
        return bool(shares) and min(shares) > LARGEST_RESIDUAL

    @cached_property
    @one_blas_thread()
    def residuals(self) -> dict[str, Residual]:
        """By type of the rows."""
        now, joint = self.statistics, self._joint
        own, beta = np.split(joint, [len(now.setup.nuisances)])
        relative = {joint_rows(i): each.relative(beta, own) for i, each in enumerate(now.joints)}
        out = {ENERGY: Residual(None, None)}
        # Where the smoother knows better, rows of the balance see shapes that are not the links'.
        momentum = None if now.method == "smoother" else now.momentum
        for name, speeds in row_types(self.model.layout).items():
            whitened = None if momentum is None else momentum.rows.whitened(speeds, joint)
            out[name] = Residual(relative.get(name), whitened)
        return out

    @property
    def _joint(self) -> Array:
        """Nuisances and parameters that residuals are for; zeros for the nuisances where another balance gives it.

        Where parameters have moved, sums of rows are free of that, and so are these.
        """
        momentum = self.statistics.momentum
        if self.statistics.method == "momentum" and momentum is not None and momentum.reference is not None:
            return momentum.reference
        # An attenuated estimate of what rows hardly determine would leave its signal in the residual.
        found, m = nearer(self.estimate, *described(self.model, self.base)), len(self.statistics.setup.nuisances)
        by_balance = self.statistics.method != "smoother" and found.size == m + self.base.n
        return found if by_balance else np.concatenate((np.zeros(m), found[found.size - self.base.n :]))

    @cached_property
    @one_blas_thread()
    def estimates(self) -> tuple[tuple[Estimate, Array], ...]:
        """Of each chosen tracker, the judged one first, its estimate and 1σ (n,) as it is reported, see `std`.

        The judged one alone where the energy balance gives the estimate.
        """
        others = self.statistics.readings[1:]
        return ((self.estimate, self.std), *((each.estimate, self._reported(each.estimate)) for each in others))

    @cached_property
    @one_blas_thread()
    def trackers(self) -> tuple[TrackerResult, ...]:
        """Results of each chosen tracker, the judged one first; empty where the energy balance gives the estimate.

        Empty for the smoother, too, where no other than its own least squares is chosen.
        """
        now = self.statistics
        readings = now.readings
        if not readings and now.method != "momentum":
            return ()
        if not readings:
            rate = rows_per_second(self.model.layout.n_v, self.model.system.windows.momentum)
            readings = (Reading(now.setup.trackers[0].label, self.estimate, self.estimate.rows / rate),)
        out = []
        for k, (reading, (estimate, std)) in enumerate(zip(readings, self.estimates, strict=True)):
            numbers = (estimate.pi.tolist(), std.tolist(), self._determined(estimate, std).tolist())
            tracked = {p.name: Tracked(*each) for p, *each in zip(self.parameters, *numbers, strict=True)}
            consistency = Consistency.of(estimate)
            moving = [(self.parameters[drift.column], drift, drift.column) for drift in reading.drifts]
            drifts = tuple(
                Drift(
                    p.name,
                    p.unit,
                    drift.since,
                    drift.changed,
                    drift.rate,
                    drift.std,
                    float(estimate.pi[column]),
                    float(std[column]),
                )
                for p, drift, column in moving
            )
            memory = min(reading.memory, now.duration)
            out.append(TrackerResult(reading.label, k == 0, tracked, consistency, memory, drifts))
        return tuple(out)

    @cached_property
    def calibration(self) -> list[Calibration]:
        """The calibration constants that the session determines better than the description's tolerances."""
        estimate, setup = self.estimate, self.statistics.setup
        nuisances = setup.smoothed if self.statistics.method == "smoother" else setup.nuisances
        if estimate.nuisances.size != len(nuisances) or estimate.dof <= 0.0 or not self.determined.any():
            return []
        std = max(1.0, float(np.sqrt(estimate.rss / estimate.dof))) * estimate.nuisances_std
        if (self._misfit or self.statistics.method == "smoother") and estimate.nuisances_robust is not None:
            std = np.maximum(std, estimate.nuisances_robust)
        return found(nuisances, estimate.nuisances, std)

    @cached_property
    @one_blas_thread()
    def attenuated(self) -> list[str]:
        """Names of parameters that noise in the columns biases by more than their std: errors in variables.

        The comparison is Hausman's, of least squares with an estimate that is free of this bias.
        """
        if self.statistics.method != "momentum":
            return []
        shift = np.abs(self.statistics.shift(self.estimate))
        return [p.name for p, s, d in zip(self.parameters, shift, self.std, strict=True) if s > LARGEST_BIAS * d]

    @cached_property
    @one_blas_thread()
    def projection(self) -> Projection | None:
        """The physically consistent parameters nearest to the estimate; None where they are not found.

        A finished session is not lost for it. It takes too long to be made of a session that runs, and is None then.
        """
        if not self.statistics.finished:
            return None
        std, estimate = self.std, self.estimate
        known = np.flatnonzero(np.isfinite(std))
        stated = estimate.std[known]
        scale = np.divide(std[known], stated, out=np.ones_like(stated), where=stated > 0.0)
        covariance = np.diag(np.full(std.size, np.inf))
        covariance[np.ix_(known, known)] = estimate.covariance[np.ix_(known, known)] * np.outer(scale, scale)
        # Where none is described, its parameters are those of a jump.
        changes = ["payload"] if self.statistics.setup.system.payload is None else []
        try:
            return PhysicalSet(self.model, self.base, changes).project(estimate.pi, covariance)
        except ArithmeticError:
            return None

    @cached_property
    def comparison(self) -> NominalComparison:
        """The determined parameters against the values that the system file states; those of effects count as none."""
        known = np.flatnonzero(self.determined)
        names = [self.parameters[k].name for k in known]
        nominal = {p.name: p.nominal for p in self.parameters if "@" not in p.name}
        return compare(names, self.estimate.pi[known], self.std[known], nominal, unit_factors(self.model.system))

    @property
    def negative(self) -> list[str]:
        """Names of parameters that are negative beyond their interval and cannot be."""
        names = [p.name for p in self.parameters]
        return negative(names, self.estimate.pi, np.where(self.determined, self.std, np.inf))
