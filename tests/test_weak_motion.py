"""Motions too weak to determine an arm: wide intervals and a request for more motion, not wrong parameters."""

from __future__ import annotations

import numpy as np
import pytest

import sms_online as sms
from sms_adapters.system_file import load_system
from sms_online.description.schema import Harmonic, System, Trajectory
from sms_online.pipeline.description import nearer
from sms_online.pipeline.plain_rows import PlainRows
from sms_online.trackers.interface import Estimate
from tests.campaigns.sessions import disguised, true_parameters

NORMAL_95 = 1.96


def estimate(pi: list[float], std: list[float]) -> Estimate:
    known = np.isfinite(std)
    covariance = np.diag(np.where(known, np.square(std), np.inf))
    return Estimate(np.array(pi), covariance, None, known, 1.0, 100.0, 100.0, 100.0)


def test_weights_take_from_the_description_what_rows_do_not_say() -> None:
    """Standard deviations much below, equal to and above the described size, and none."""
    value, size = np.full(4, 10.0), np.full(4, 10.0)
    found = nearer(estimate([20.0, 20.0, 2e5, 7.0], [0.1, 10.0, 1e6, np.inf]), value, size)
    np.testing.assert_allclose(found, [20.0 - 1e-3, 15.0, 10.0 + 2e5 * 1e-10, 10.0], rtol=1e-4)


def test_without_a_described_size_weights_follow_the_rows() -> None:
    found = nearer(estimate([20.0, 3.0], [5.0, 50.0]), np.array([10.0, 0.0]), np.array([10.0, 0.0]))
    np.testing.assert_allclose(found, [18.0, 3.0])


@pytest.mark.parametrize("beta", [0.5, 1.0, 3.0])
def test_noise_that_grows_with_the_parameters_is_no_misfit(beta: float) -> None:
    """Rows of a column that is noise alone, whitened with β = 1: 3 β leaves nine times their variance. Seed 2."""
    rng = np.random.default_rng(2)
    plain = PlainRows.none(1, 1)
    for noise, sample in rng.standard_normal((400, 2)):
        plain.add(np.array([[noise, 0.0]]), np.array([[sample, 0.0]]), np.ones(1), np.ones(1))
    assert plain.whitened([0], np.array([beta])) == pytest.approx(1.0, abs=0.12)
    assert not plain.excess(np.array([beta])).any()


def moved(first: Harmonic, second: Harmonic, duration: float) -> System:
    motion = Trajectory(duration=duration, joints=((first,), (second,)))
    return load_system("paper-planar").model_copy(update={"trajectory": motion})


SLOW = Harmonic(frequency=0.3, sine=0.1)
USUAL = Harmonic(frequency=np.pi / 2, sine=1.3)
STILL = Harmonic(frequency=np.pi / 2)


@pytest.mark.long
@pytest.mark.parametrize(
    ("system", "level", "why"),
    [
        (moved(USUAL, STILL, 20.0), "trust", None),
        (moved(USUAL, USUAL, 2.0), "not yet", "too few rows"),
    ],
    ids=["one joint", "two seconds"],
)
def test_intervals_of_a_weak_motion_hold_the_truth(system: System, level: str, why: str | None) -> None:
    """Seeds 0 and 1, from descriptions that are wrong by up to 30 %. Deviations of neighbours are almost one."""
    truth = true_parameters(system)
    for seed in range(2):
        assert system.trajectory is not None
        data = sms.simulate(system, duration=system.trajectory.duration, grade="B", seed=seed)
        result = sms.estimate(disguised(system, np.random.default_rng(seed)), data)
        known = [p.determined for p in result.parameters.values()]
        off = [(p.value - true) / p.std for p, true in zip(result.parameters.values(), truth, strict=True)]
        assert np.mean(np.abs(np.array(off)[known]) < NORMAL_95) >= 0.85
        assert np.max(np.abs(np.array(off)[known])) < 4.0
        assert result.trust.level == level
        assert not result.trust.grave
        assert why is None or why in result.trust.sentence


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_torques_that_are_noise_determine_nothing(seed: int) -> None:
    """0.1 rad at 0.05 Hz. Noise's size, not the motion, would determine what a fit then gives."""
    data = sms.simulate(moved(SLOW, SLOW, 20.0), duration=20.0, grade="B", seed=seed)
    result = sms.estimate(disguised(moved(SLOW, SLOW, 20.0), np.random.default_rng(seed)), data)
    assert not any(p.determined for p in result.parameters.values())
    assert not result.calibration
    assert result.trust.level == "not yet"
    assert "weak data" in result.trust.sentence
    assert "move" in result.trust.next_step
