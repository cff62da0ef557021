"""Error bars under noise: normalised errors over many seeds, bounded from both sides."""

from __future__ import annotations

import numpy as np
import pytest

from sms_online.description.parse import parse_system
from sms_online.evaluation import beside_prior, identifiable
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array, Block
from sms_online.trackers.interface import Estimate, Prior
from tests.axis import AXIS, DAMPING, INERTIA
from tests.evaluated import standard_deviation

SEEDS = 40
SECONDS, RATE = 10.0, 200.0


def normalised_errors(torque_noise: float, position_noise: float) -> Array:
    """(SEEDS, 2): errors of inertia and damping of a moved axis over their reported standard deviations."""
    system = parse_system(AXIS, "axis.toml")
    t = np.arange(round(SECONDS * RATE)) / RATE
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    rate, acceleration = 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t), -4 * np.sin(2 * t) - 7.5 * np.sin(5 * t)
    exact = np.stack((INERTIA * acceleration + DAMPING * rate, q), axis=1)
    out = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        noise = rng.standard_normal(exact.shape) * [torque_noise, position_noise]
        estimator = Estimator(system, ("force_1", "q_1"), "axis")
        estimator.push(Block(t, ("force_1", "q_1"), exact + noise))
        estimator.finish()
        out.append((estimator.estimate().pi - [INERTIA, DAMPING]) / standard_deviation(estimator))
    return np.array(out)


@pytest.mark.long
@pytest.mark.parametrize(("torque_noise", "position_noise"), [(0.1, 0.0), (0.01, 1e-4)])
def test_error_bars_are_neither_too_small_nor_too_large(torque_noise: float, position_noise: float) -> None:
    """Torque noise is integrated into the work, position noise is in every rate: both have to be in the error bar.

    The root mean square of 40 normalised errors of deviation one lies between 0.7 and 1.35 in 99.7 %. Bars may be
    wider, since the larger of two answers is reported, but not without bound.
    """
    rms = np.sqrt(np.mean(normalised_errors(torque_noise, position_noise) ** 2, axis=0))
    assert (rms < 1.35).all(), rms
    assert (rms > 0.2).all(), rms


def posterior(prior: Prior, rows: Array, rows_std: Array) -> Estimate:
    """What priors and independent estimates by rows give together."""
    information = prior.std**-2.0 + rows_std**-2.0
    pi = (prior.value / prior.std**2 + rows / rows_std**2) / information
    determined = np.ones(pi.size, dtype=np.bool_)
    return Estimate(pi, np.diag(1.0 / information), None, determined, 1.0, 100.0, 90.0, 90.0)


def test_what_rows_say_is_the_posterior_less_its_prior() -> None:
    prior = Prior(np.array([4.0, 4.0]), np.array([0.4, 0.4]))
    rows, rows_std = np.array([5.5, -2.0]), np.array([0.3, 2.0])
    estimate = posterior(prior, rows, rows_std)
    value, std = beside_prior(estimate, estimate.std, prior)
    np.testing.assert_allclose(value, rows)
    np.testing.assert_allclose(std, rows_std)
    # The second is ten of its deviations from zero, but not by what the rows say.
    assert identifiable(estimate.pi, estimate.std).all()
    assert identifiable(value, std).tolist() == [True, False]


def test_rows_that_say_nothing_leave_a_prior_undetermined() -> None:
    prior = Prior(np.array([4.0, 4.0]), np.array([0.4, np.nan]))
    estimate = posterior(Prior(prior.value, np.array([0.4, 1e9])), np.array([4.0, 7.0]), np.array([np.inf, 0.1]))
    value, std = beside_prior(estimate, estimate.std, prior)
    assert identifiable(value, std).tolist() == [False, True]
