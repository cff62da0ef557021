"""Heavy-tailed tolerances: a value that the samples clearly contradict is released, and biases nothing else.

A description that is wrong by many tolerances in one number would otherwise be corrected in part, and π biased by
the rest. The tails are those of Student's t, see `pipeline.prior_information`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import itemgetter

import numpy as np

from sms_online.calibration.nuisance import Nuisance
from sms_online.pipeline.prior_information import TAIL
from sms_online.stream import Array
from sms_online.trackers.interface import Estimate

# Within this many tolerances, which chance may explain, a tolerance counts as stated.
NORMAL = 2.0
# Deviations of what rows make of a tolerance that chance does not explain, and what rounding makes of one.
UNLIKELY, ROUNDING = 3.0, 1e-6
# Weights and estimate follow each other; so many times at most, until no weight changes by more than this.
PASSES, SAME = 20, 1e-6
# A tolerance counts at least this share of its information: what else determines a nuisance must do so by itself.
LEAST = 1e-9


def at_most_tolerances(block: Array) -> Array:
    """A covariance (k, k) in units of tolerances that are part of it: rounding may make it larger than these alone."""
    size, axes = np.linalg.eigh(block)
    return np.asarray((axes * np.minimum(size, 1.0)) @ axes.T)


def release_gain(block: Array, weight: Array) -> Array:
    """What a covariance gains where tolerances keep a share of their information: G (k, k) in P + C G Cᵀ.

    block (k, k): covariance of k nuisances in units of their tolerances, see `at_most_tolerances`. weight (k,): the
    shares. C (n, k): covariances with the nuisances in these units. Source: the identity of Woodbury.
    """
    lost = 1.0 - weight
    return np.asarray(np.linalg.solve(np.eye(lost.size) - lost[:, None] * block, np.diag(lost)))


def released(estimate: Estimate, nuisances: Sequence[Nuisance], squares: Array) -> Estimate:
    """The estimate (nuisances first) as if each tolerance beyond `NORMAL` were one of heavier tails.

    squares (n, n): covariance by least squares. What corrections for noise add to it is no information. That of a
    tolerance on a nuisance ν is replaced by h / tolerance², with h = (1 + NORMAL² / TAIL) / (1 + (ν / tolerance)² /
    TAIL), see `release_gain`. Those of torques keep theirs. What a tolerance no longer asks for is no residual either.
    """
    m = len(nuisances)
    tolerance = np.array([each.tolerance for each in nuisances])
    may = np.array([np.isfinite(each.tolerance) and each.may_give_way for each in nuisances], dtype=np.bool_)
    known = np.flatnonzero(may & estimate.determined[:m])
    if not known.size:
        return estimate
    # Beside a prior all rows were weighted with one factor, these among them.
    unit = tolerance[known] * (1.0 if estimate.scale is None else estimate.scale)
    C, start = squares[:, known] / unit, estimate.pi[known] / unit
    block = at_most_tolerances(C[known] / unit[:, None])
    # A tolerance far below what the rows know may keep a value within it that they contradict.
    expected = np.sqrt(np.maximum(0.0, 1.0 - np.diag(block)))
    if not np.any(np.abs(start) > np.minimum(NORMAL, UNLIKELY * expected + ROUNDING)):
        return estimate
    names = np.array([nuisances[k].name for k in known.tolist()])
    # What is wrong in one kind alone may look like a little of many: such are the minima to begin from.
    begun = [start, *(_value(start, block, np.where(names == name, LEAST, 1.0))[0] for name in dict.fromkeys(names))]
    _, gain = min((_minimum(start, block, value) for value in begun), key=itemgetter(0))
    covariance = estimate.covariance + C @ gain @ C.T
    rss = max(0.0, estimate.rss - float(start @ gain @ start))
    return replace(estimate, pi=estimate.pi + C @ (gain @ start), covariance=covariance, rss=rss)


def _value(start: Array, block: Array, weight: Array) -> tuple[Array, Array]:
    """Nuisances (k,) where tolerances keep a share (k,) of their information, and the gain behind them."""
    gain = release_gain(block, weight)
    return start + block @ (gain @ start), gain


def _minimum(start: Array, block: Array, value: Array) -> tuple[float, Array]:
    """What rows and tolerances leave at the minimum nearest to a value (k,), and the gain that leads there."""
    weight = np.ones(start.size)
    for _ in range(PASSES):
        before = weight
        weight = np.clip((1.0 + NORMAL**2 / TAIL) / (1.0 + value**2 / TAIL), LEAST, 1.0)
        value, gain = _value(start, block, weight)
        if np.max(np.abs(weight - before)) < SAME:
            break
    drawn = gain @ start
    beyond = np.maximum(0.0, value**2 - NORMAL**2)
    tails = (TAIL + NORMAL**2) * np.log1p(beyond / (TAIL + NORMAL**2)) - beyond
    return float(drawn @ block @ drawn + tails.sum()), gain
