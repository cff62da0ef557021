"""Fits whose masses, springs and friction are not negative."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from scipy.optimize import lsq_linear

from sms_online.diagnosis.evidence import bounded
from sms_online.effects.possible import not_negative

POSITIVE = np.array([True, False, True, True, False])


def test_a_bounded_fit_is_the_best_of_those_that_are_not_negative() -> None:
    """Against scipy's bounded least squares, on columns of very different sizes, seeds 0 to 9."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        columns = rng.normal(size=(60, 5)) * [1.0, 1e4, 1e-3, 10.0, 1e2]
        b = rng.normal(size=60)
        found = bounded(columns, b, POSITIVE)
        size = np.linalg.norm(columns, axis=0)
        least = lsq_linear(columns / size, b, (np.where(POSITIVE, 0.0, -np.inf), np.inf), tol=1e-12).x / size
        assert np.all(found[POSITIVE] >= 0.0)
        assert np.linalg.norm(columns @ found - b) <= np.linalg.norm(columns @ least - b) * (1.0 + 1e-9)
        assert_allclose(found * size, least * size, atol=1e-6)


def test_what_cannot_be_negative() -> None:
    for name in ("joint_1.stiffness", "motor_2.rotor_inertia", "viscous_friction@joint_1.damping"):
        assert not_negative(name)
    # Of either sign: a cubic spring that softens, an offset, a first moment.
    for name in ("cubic_stiffness@joint_1.stiffness", "torque_offset@joint_1.torque", "link_1.first_moment_x"):
        assert not not_negative(name)


def test_a_column_that_others_make_stays_bounded() -> None:
    """Rounding leaves of it what no fit may divide by."""
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(20, 4))
    columns[:, 3] = columns[:, 0]
    found = bounded(columns, rng.normal(size=20), np.array([False, True, True, True]))
    assert np.abs(found).max() < 10.0
