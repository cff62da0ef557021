"""A gain's column holds noise of the rows it is fitted to: what they share is taken off, and bars hold."""

from __future__ import annotations

import numpy as np
import pytest

import sms_online as sms
from sms_online.calibration.multiplied_noise import SAMPLES, Multiplied, MultipliedNoise, Shares
from sms_online.pipeline.errors_in_variables import NoiseBias
from sms_online.pipeline.gram_sum import GramSum
from sms_online.pipeline.momentum_windows import STEPS
from sms_online.pipeline.row_noise import RowNoise

SPAN = 0.4
WINDOWS = 4000

# Friction makes most of joint 2's torque, so that a gain of its torque changes little else. Its encoders are fine.
ARM = """
name = "two geared joints"
motion = "planar"
sample_rate = 500.0

[joint_1]
gear_ratio = 50.0
transmission = "rigid"
[motor_1]
rotor_inertia = 4e-5
[joint_2]
gear_ratio = 50.0
transmission = "rigid"
[motor_2]
rotor_inertia = 2e-5

[link_1]
kind = "rigid"
mass = 4.0
center_of_mass = [0.2, 0.0, 0.0]
inertia = { xx = 0.01, yy = 0.1, zz = 0.1 }
tip = [0.4, 0.0, 0.0]
[link_2]
kind = "rigid"
mass = 1.0
center_of_mass = [0.1, 0.0, 0.0]
inertia = { xx = 0.001, yy = 0.01, zz = 0.01 }

[[effect]]
name = "coulomb_friction"
where = "joint_1"
coefficients = { torque = 6.0 }
[[effect]]
name = "coulomb_friction"
where = "joint_2"
coefficients = { torque = 4.0 }
[[effect]]
name = "viscous_friction"
where = "joint_2"
coefficients = { damping = 3.0 }

[[sensor]]
channels = ["tau_*"]
noise = 0.003
[[sensor]]
channels = ["q_*"]
resolution = 5e-5

[controller]
stiffness = [4000.0, 2000.0]
damping = [300.0, 100.0]
[trajectory]
duration = 30.0
joint_1 = [{ frequency = 0.9, sine = 0.6 }, { frequency = 2.3, cosine = 0.2 }]
joint_2 = [{ frequency = 1.3, sine = 0.8 }, { frequency = 3.1, cosine = 0.2 }]
"""


def test_synthetic_rows_have_the_covariance_of_the_noise() -> None:
    # One sensor and one torque, in two rows each alone; the covariance is that of `RowNoise`.
    random = np.random.default_rng(1)
    kernel = random.standard_normal((STEPS + 1, 1, 1)) * np.array([[[1.0], [0.0]]])
    kernels = np.repeat(kernel[None], WINDOWS, axis=0)
    sensor, torque = np.array([3.0]), np.array([0.5])
    synthetic = MultipliedNoise([Multiplied(0, sensors=(0,)), Multiplied(1, joints=(0,))], 1, [1], SPAN)
    rows = synthetic.push(kernels, sensor, torque)
    late, free = np.zeros((20, 2, 1)), np.zeros((20, 0, 2))
    covariances = RowNoise((1,), SPAN).covariances(kernels[:20], late, sensor, torque, free, np.zeros(20))[-1]
    for hops in range(len(covariances)):
        of_sensor = np.mean(rows[hops:, 0, 0] * rows[: WINDOWS - hops, 0, 0])
        of_torque = np.mean(rows[hops:, 1, 1] * rows[: WINDOWS - hops, 1, 1])
        size = np.diag(covariances[-1])
        assert abs(of_sensor - covariances[-1 - hops][0, 0]) < 0.1 * size[0]
        assert abs(of_torque - covariances[-1 - hops][1, 1]) < 0.1 * size[1]
    assert not rows[:, 1, 0].any()


@pytest.mark.parametrize("stated", [1.0, 2.0])
def test_a_cleaned_column_does_not_correlate_with_residuals(stated: float) -> None:
    # Noise of a torque is 0.6 of a row's variance; positions' noise, the rest, may be stated too large.
    random = np.random.default_rng(2)
    torque, positions = np.sqrt(0.6) * random.standard_normal(WINDOWS), random.standard_normal(WINDOWS) * np.sqrt(0.4)
    deviation = np.sqrt(0.6 + 0.4 * stated)
    column, residual = (10.0 + torque) / deviation, (torque + positions) / deviation
    synthetic = np.sqrt(0.6) * random.standard_normal((WINDOWS, SAMPLES)) / deviation
    shares = Shares([0], 1)
    every = [
        shares.taken_off(np.array([[a]]), b[None, None], np.array([c]))
        for a, b, c in zip(column, synthetic, residual, strict=True)
    ]
    cleaned = np.array([N[0, 0] for N, _ in every])
    noise = residual - residual.mean()
    assert noise @ (column - column.mean()) > 0.4 * WINDOWS / deviation**2
    assert abs(noise @ (cleaned - cleaned.mean())) < 0.05 * WINDOWS / deviation**2
    assert np.mean([left[0, 0] != 0.0 for _, left in every]) < 1e-3


def test_a_residual_that_is_no_noise_leaves_the_column() -> None:
    """The noise stays in it, and its sample with it, for normal equations to be freed of."""
    shares = Shares([0], 1)
    N, left = shares.taken_off(np.array([[3.0]]), np.full((1, 1, SAMPLES), 0.7), np.array([40.0]))
    assert (N[0, 0], left[0, 0]) == (3.0, 0.7)
    N, left = shares.taken_off(np.array([[3.0]]), np.full((1, 1, SAMPLES), 0.7), np.array([1.0]))
    assert N[0, 0] < 3.0
    assert left[0, 0] == 0.0


def test_noise_of_a_torque_does_not_pull_its_gain() -> None:
    """Two joints whose torques one parameter makes, and a gain of the first, which is zero. Seed 2."""
    random = np.random.default_rng(2)
    torque, noise = 10.0 * random.standard_normal((WINDOWS, 1)), random.standard_normal((WINDOWS, 2))
    synthetic = random.standard_normal((WINDOWS, 2))
    Y, gained = torque * np.array([1.0, 0.5]), np.array([1.0, 0.0])
    b = Y + noise
    rows = np.stack([b * gained, Y, b], axis=2)
    prior = np.array([[20.0, 0.0, 0.0]])
    bias, grams = NoiseBias.none(2, prior, [0]), GramSum.none(2, 3, [0])
    for each, own in zip(rows, synthetic * gained, strict=True):
        bias.add(each, np.stack((each, each)), own[:, None])
        grams.add(each[:, None], own[:, None])
    everything = np.concatenate((prior, rows.reshape(-1, 3)))
    squares = np.linalg.lstsq(everything[:, :2], everything[:, 2])[0]
    freed = squares + bias.correction(np.array([True, True])).shift
    gram = grams.matrices.sum(axis=0) + prior.T @ prior
    solved = np.linalg.solve(gram[:2, :2], gram[:2, 2])
    std = np.sqrt(np.linalg.inv(gram[:2, :2])[0, 0])
    assert abs(freed[0]) < 2.0 * std
    assert abs(solved[0]) < 2.0 * std
    assert squares[0] > 8.0 * std
    # What remains is scatter of synthetic noise, which is no bias.
    assert not bias.correction(np.array([True, True])).columns.any()


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1])
def test_noise_of_a_torque_makes_no_gain(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    path = tmp_path_factory.mktemp("arm") / "arm.toml"
    path.write_text(ARM)
    system = sms.load_system(path)
    result = sms.estimate(system, sms.simulate(system, duration=30.0, seed=seed))
    for name, true in (("coulomb_friction@joint_2.torque", 4.0), ("viscous_friction@joint_2.damping", 3.0)):
        found = result.parameters[name]
        assert abs(found.value - true) < 3.0 * found.std
        assert found.std < 0.02 * true
