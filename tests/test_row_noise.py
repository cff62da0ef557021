"""Predicted noise of momentum rows is what rows of noisy readings scatter by; whitening removes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.parse import parse_system
from sms_online.description.schema import Effect, System
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.latency import SourceGroup
from sms_online.pipeline.momentum_balance import MomentumBalance
from sms_online.pipeline.momentum_windows import COPIES, EXPONENT, HOPS, INSTANTS, STEPS, Window
from sms_online.pipeline.rough_forces import stiction_std
from sms_online.pipeline.row_noise import CLOCK_ERROR, CLOCK_KNOWN, RowNoise
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensitivity import Sensitivities
from sms_online.pipeline.sensor_noise import NoiseEstimate
from sms_online.pipeline.weak_form import test_function as weak_test_function
from sms_online.pipeline.whitening import ROUNDING, Whitener, Whitening
from sms_online.stream import Array
from sms_sim.plant import Plant
from tests.axis import AXIS
from tests.model_systems import paper, spatial
from tests.prescribed_motion import prescribed

SPAN = 0.4  # s
# Small enough that rows are linear in it, large against rounding. rad and m; N m of the joint torque.
POSITION_NOISE, TORQUE_NOISE = 1e-6, 1e-3


def _no_free_forces(windows: int) -> Array:
    return np.empty((windows, 0, 0))


# Windows after the first.
HOPS_FOLLOWED = 3
AXIS_SYSTEM = parse_system(AXIS.replace("sample_rate = 200.0", "sample_rate = 1000.0"), "axis.toml")
# A phase of 25 Hz, where the filter of the motion passes half the noise, friction and a hard spring:
# they multiply the variance of their joints' rows.
ROUGH = (
    Effect(name="cogging", where="joint_2", coefficients={"amplitude": 150.0, "phase": 0.4, "order": 2.0}),
    Effect(name="viscous_friction", where="joint_1", coefficients={"damping": 500.0}),
    Effect(name="cubic_stiffness", where="joint_1", coefficients={"stiffness": 5e6}),
)
# With the number of draws: fewer where rows are dear.
SYSTEMS = [
    pytest.param(paper(), 120, id="planar"),
    pytest.param(paper(effects=ROUGH), 240, id="planar, rough forces", marks=pytest.mark.long),
    pytest.param(paper("exact"), 30, id="planar, exact links"),
    pytest.param(load_system("spatial-two-link"), 60, id="spatial"),
    pytest.param(spatial(free=False), 60, id="spatial, prismatic joint, gravity, effects", marks=pytest.mark.long),
]


@dataclass(frozen=True)
class Scatter:
    """Errors of rows of noisy readings, (draws, windows n_v), and the covariance that was predicted for them."""

    errors: Array
    covariance: Array
    whitened: Array
    n_v: int


def block_matrix(covariances: list[list[Array]]) -> Array:
    """All windows' covariance, (windows n_v, windows n_v), from each one's with those before it."""
    n_v = covariances[0][-1].shape[0]
    out = np.zeros((len(covariances) * n_v, len(covariances) * n_v))
    for i, row in enumerate(covariances):
        for j, block in enumerate(row, start=i + 1 - len(row)):
            out[i * n_v : (i + 1) * n_v, j * n_v : (j + 1) * n_v] = block
            out[j * n_v : (j + 1) * n_v, i * n_v : (i + 1) * n_v] = block.T
    return out


def scatter(system: System, draws: int, seed: int) -> Scatter:
    """Rows of one stretch of motion, exact parameters, `draws` times with new noise on every sensor."""
    model = build_model(system)
    plant = Plant(system)
    base = find_base_parameters(model)
    beta = base.values(model.nominal)
    sensing = Sensing(model, plant.channels, "test")
    order = [plant.channels.index(name) for name in sensing.channels]
    probe = MomentumBalance(model, base, system.sample_rate, SPAN)
    motion = prescribed(model, probe.width + probe.lead + probe.margin + HOPS_FOLLOWED * probe.hop + 1, seed=1)
    torque = motion.Q[:, list(model.layout.theta_m)]
    exact = plant.channel_values(torque, motion.x)[:, order]
    sigma = np.zeros(len(order))
    sigma[sensing.position_columns] = POSITION_NOISE
    gears = sensing.joint_torque(np.ones((1, len(order))))[0]
    sigma[[k for k in range(len(order)) if k not in sensing.position_columns]] = TORQUE_NOISE / gears
    rng = np.random.default_rng(seed)
    coordinates = sensing.coordinate_noise(np.full(model.layout.n_x, POSITION_NOISE))

    def windows(values: Array) -> tuple[list[Window], Sensitivities]:
        balance = MomentumBalance(model, base, system.sample_rate, SPAN)
        found, instants = balance.push(np.arange(len(values)), [sensing.motion(values)] * COPIES, coordinates)
        sensitivities = Sensitivities(model, sensing.displacements, balance.span / INSTANTS)
        for piece in instants if values is exact else []:
            sensitivities.extend(balance.rough.without(model.nominal), piece.x, piece.v, piece.signals)
        return found, sensitivities

    def residual(found: list[Window]) -> Array:
        dense = np.zeros((len(found), model.layout.n_v, base.n))
        for Y, window in zip(dense, found, strict=True):
            Y[probe.rows, probe.columns] = window.Y[0]
        return np.concatenate([Y @ beta - window.b[0] for Y, window in zip(dense, found, strict=True)])

    found, sensitivities = windows(exact)
    noise, whitener = RowNoise(model.layout.theta_m, probe.span), Whitener(draws)
    density = POSITION_NOISE**2 / system.sample_rate, TORQUE_NOISE**2 / system.sample_rate
    sensitivity = sensitivities.windows(np.array([window.start for window in found]))
    kernels = noise.kernels(sensitivity)
    responses = np.array([window.rough[0] for window in found])
    kernels += probe.rough.kernels(responses, model.nominal, sensitivity.displacements)
    densities = np.full(model.layout.n_x, density[0]), np.full(len(model.layout.q), density[1])
    late = noise.lateness(kernels, sensitivity.rates)
    covariances = noise.covariances(kernels, late, *densities, _no_free_forces(len(found)), np.full(len(found), np.inf))
    rest = residual(found)
    errors = np.stack(
        [residual(windows(exact + sigma * rng.standard_normal(exact.shape))[0]) - rest for _ in range(draws)]
    )
    n_v = model.layout.n_v
    rows = errors.T.reshape(len(found), n_v, draws)
    white = [whitener.push(covariance, row) for covariance, row in zip(covariances, rows, strict=True)]
    return Scatter(errors, block_matrix(covariances), np.concatenate(white), n_v)


@pytest.mark.parametrize(("system", "draws"), SYSTEMS)
def test_rows_of_noisy_readings_scatter_as_predicted(system: System, draws: int) -> None:
    """Variance of each row, its correlation with itself in the windows that overlap, and what whitening leaves. Seed 3.

    Bounds of the first two are 4.5 standard errors: some hundred numbers are compared.
    """
    found = scatter(system, draws, seed=3)
    sigma = np.sqrt(np.diag(found.covariance))
    normal = found.errors / sigma
    assert (np.abs(np.mean(normal**2, axis=0) - 1.0) < 4.5 * np.sqrt(2.0 / draws)).all()
    correlation = found.covariance / np.outer(sigma, sigma)
    for k in range(1, HOPS_FOLLOWED + 1):
        ahead, behind = normal[:, k * found.n_v :], normal[:, : -k * found.n_v]
        expected = np.diagonal(correlation, k * found.n_v)
        # Rows that overlap by so much are far from independent.
        assert np.abs(expected).max() > 0.3
        error = np.sqrt((1.0 + expected**2) / draws)
        assert (np.abs(np.mean(ahead * behind, axis=0) - expected) < 4.5 * error).all()
    # As well as the noise itself is estimated from a thousand samples.
    assert abs(np.mean(found.whitened**2) - 1.0) < 0.05


def test_a_clock_error_moves_rows_by_its_readings_rates() -> None:
    """Against rows of samples moved in time; windows that overlap share it, and a clock just found is off by more."""
    system = paper()
    model = build_model(system)
    base = find_base_parameters(model)
    motion = prescribed(model, 800, seed=1)
    sensors, late = (model.layout.position_names.index("q_1"), model.layout.position_names.index("q_2")), 1e-6  # s
    balance = MomentumBalance(model, base, system.sample_rate, SPAN)
    sensitivities = Sensitivities(
        model, lambda x: np.tile(np.eye(model.layout.n_v), (len(x), 1, 1)), balance.span / INSTANTS
    )

    def windows(delay: float) -> list[Array]:
        x = motion.x.copy()
        x[:, sensors] -= delay * motion.v[:, sensors]
        balance.begin_segment()
        signals = np.zeros((len(x), len(model.layout.q)))
        found, instants = balance.push(np.arange(len(x)), [np.concatenate((x, signals), axis=1)] * COPIES, np.ones(15))
        for piece in instants if delay == 0.0 else []:
            sensitivities.extend(model.nominal, piece.x, piece.v, piece.signals)
        dense = np.zeros((len(found), model.layout.n_v, base.n))
        for Y, window in zip(dense, found, strict=True):
            Y[balance.rows, balance.columns] = window.Y[0]
        starts.extend(window.start for window in found if delay == 0.0)
        return list(dense @ base.values(model.nominal))

    starts: list[int] = []
    still, moved = windows(0.0), windows(late)
    slopes = [(b - a) / late for a, b in zip(still, moved, strict=True)]
    clock = SourceGroup("encoders", sensors, (), ())
    noise = RowNoise(model.layout.theta_m, balance.span, (clock,))
    nothing = np.zeros(model.layout.n_x), np.zeros(len(model.layout.q))
    sensitivity = sensitivities.windows(np.array(starts))
    kernels = noise.kernels(sensitivity)
    lateness = noise.lateness(kernels, sensitivity.rates)
    W = len(starts)
    found = noise.covariances(kernels, lateness, *nothing, _no_free_forces(W), np.full(W, np.inf))
    assert len(found) > 2
    for k in range(2):  # a window with itself and with the one before
        expected = (1.0 - k / HOPS) * CLOCK_ERROR**2 * np.outer(slopes[-1], slopes[-1 - k])
        np.testing.assert_allclose(found[-1][-1 - k], expected, atol=0.02 * np.abs(expected).max())
    young = RowNoise(model.layout.theta_m, balance.span, (clock,))
    age = np.array([0.5 * CLOCK_KNOWN])
    own = young.covariances(kernels[-1:], lateness[-1:], *nothing, _no_free_forces(1), age)[0][-1]
    np.testing.assert_allclose(own, 4.0 * found[-1][-1], rtol=1e-12)


def test_windows_inform_beside_an_unmodelled_force() -> None:
    """A constant force of 2 N m, beside any force from 1 to 1.3 s: by windows together, though all of them see that.

    Ten times as well as if it were another error in each window.
    """
    rng = np.random.default_rng(8)
    half_hop, dt, sigma = 20, 1e-3, 0.01
    width = INSTANTS * half_hop
    phi = weak_test_function(width, SPAN, EXPONENT)[0] * dt
    time = np.arange(1600)
    resting = (time >= 1000) & (time < 1300)
    windows = [slice(start, start + width + 1) for start in range(640, 1000, 2 * half_hop)]
    assert all(np.any(resting[inside]) for inside in windows)
    nothing = np.zeros((1, STEPS + 1, 1, 1)), np.zeros((1, 1, 1)), np.zeros(1), np.array([sigma**2 * dt])
    errors, alone = [], 0.0
    for draw in range(50):
        force = 2.0 + sigma * rng.standard_normal(time.size)
        force[resting] += 20.0 * rng.standard_normal() + np.cumsum(rng.standard_normal(300))
        noise, whitener = RowNoise((0,), SPAN), Whitener(2)
        white = []
        for inside in windows:
            free = stiction_std(np.full((width + 1, 1), 20.0), resting[inside, None], phi)
            (covariances,) = noise.covariances(*nothing, free[None], np.array([np.inf]))
            white.append(whitener.push(covariances, np.array([[phi.sum(), phi @ force[inside]]])))
            alone += float(phi.sum() ** 2 / covariances[-1][0, 0]) if draw == 0 else 0.0
        column, rows = np.concatenate(white).T
        errors.append((column @ rows - 2.0 * (column @ column)) / np.linalg.norm(column))
    assert column @ column > 10.0**2 * alone
    assert np.sqrt(np.mean(np.square(errors))) < 1.5


def test_windows_together_have_the_covariances_of_single_ones() -> None:
    rng = np.random.default_rng(5)
    W, n_v, sensors = 25, 3, 4
    clocks = (SourceGroup("a", (0, 1), (1,), ()), SourceGroup("b", (2, 3), (), ()))
    kernels, late = rng.standard_normal((W, STEPS + 1, n_v, sensors)), rng.standard_normal((W, n_v, sensors))
    densities, free = (np.full(sensors, 2.0), np.full(1, 3.0)), np.abs(rng.standard_normal((W, INSTANTS, n_v)))
    ages = np.linspace(0.0, 2.0 * CLOCK_KNOWN, W)
    noise = RowNoise((0,), SPAN, clocks)
    whole = noise.covariances(kernels, late, *densities, free, ages)
    parted = RowNoise((0,), SPAN, clocks)
    found = [
        covariances
        for part in (slice(0, 1), slice(1, 4), slice(4, 20), slice(20, W))
        for covariances in parted.covariances(kernels[part], late[part], *densities, free[part], ages[part])
    ]
    assert [len(each) for each in whole] == [min(HOPS, k + 1) for k in range(W)]
    for one, other in zip(whole, found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12 * np.abs(one).max())


def random_banded(n_v: int, windows: int, seed: int) -> list[list[Array]]:
    """Covariances of windows that share noise with HOPS - 1 windows before: moving averages of white noise."""
    rng = np.random.default_rng(seed)
    # Window i weights sources i … i + HOPS - 1 with n_v rows of their own, three sources a hop.
    weights = rng.standard_normal((windows, n_v, 3 * HOPS))
    dense = np.zeros((windows, n_v, 3 * (windows + HOPS)))
    for i in range(windows):
        dense[i, :, 3 * i : 3 * (i + HOPS)] = weights[i]
    return [[dense[i] @ dense[j].T for j in range(max(0, i - HOPS + 1), i + 1)] for i in range(windows)]


def test_whitening_is_the_dense_cholesky_factor_solved_for() -> None:
    """Of 25 windows at once, far beyond what one window overlaps with. Seed 5."""
    n_v, windows, width = 4, 25, 3
    covariances = random_banded(n_v, windows, seed=5)
    rows = np.random.default_rng(5).standard_normal((windows, n_v, width))
    whitener = Whitener(width)
    found = np.concatenate([whitener.push(c, row) for c, row in zip(covariances, rows, strict=True)])
    full = block_matrix(covariances)
    full[np.diag_indices_from(full)] *= 1.0 + ROUNDING
    np.testing.assert_allclose(found, np.linalg.solve(np.linalg.cholesky(full), np.concatenate(rows)), rtol=1e-8)


def test_a_covariance_that_rounding_leaves_indefinite_is_whitened() -> None:
    """Two windows that share all their noise but for what is off by 1e-9 of its variance."""
    covariances = [[np.eye(2)], [(1.0 + 1e-9) * np.eye(2), np.eye(2)]]
    rows = np.random.default_rng(3).standard_normal((2, 2, 3))
    whitener = Whitener(3)
    streamed = [whitener.push(c, row) for c, row in zip(covariances, rows, strict=True)]
    assert np.isfinite(streamed).all()
    assert np.isfinite(Whitening(covariances, np.zeros((2, 2))).of(rows)).all()
    with pytest.raises(np.linalg.LinAlgError):
        Whitening([[np.eye(2)], [1.1 * np.eye(2), np.eye(2)]], np.zeros((2, 2)))


def test_a_capture_is_whitened_like_a_stream() -> None:
    covariances = random_banded(4, 25, seed=9)
    rows = np.random.default_rng(9).standard_normal((25, 4, 3))
    whitener = Whitener(3)
    streamed = [whitener.push(c, row) for c, row in zip(covariances, rows, strict=True)]
    whole = Whitening(covariances, np.zeros((25, 4)))
    np.testing.assert_allclose(whole.of(rows), np.concatenate(streamed), rtol=1e-9)
    full = block_matrix(covariances)
    full[np.diag_indices_from(full)] *= 1.0 + ROUNDING
    np.testing.assert_allclose(whole.std.ravel(), np.diag(np.linalg.cholesky(full)), rtol=1e-8)


def test_whitening_after_a_break_remembers_nothing() -> None:
    covariances = random_banded(4, 12, seed=6)
    rows = np.random.default_rng(6).standard_normal((12, 4, 2))
    whitener = Whitener(2)
    first = [whitener.push(c, row) for c, row in zip(covariances, rows, strict=True)]
    whitener.begin_segment()
    second = [whitener.push(c, row) for c, row in zip(covariances, rows, strict=True)]
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    ("rate", "grid"),
    [(1000.0, 1000.0), (240.0, 240.0), (250.0, 1000.0), (240.0, 1000.0)],
    ids=lambda rate: f"{rate:g} Hz",
)
def test_noise_is_estimated_from_own_samples_at_any_rate(rate: float, grid: float) -> None:
    """An angle sampled at `rate`, in rows of a capture at `grid`; of noise only the density σ² T_s matters. Seed 7.

    1000 samples give σ to 5 % and so the density to 10 %; three times that is allowed.
    """
    sensing = Sensing(build_model(AXIS_SYSTEM), ("force_1", "q_1"), "test")
    estimate = NoiseEstimate(sensing, AXIS_SYSTEM.sample_rate, 5.0)
    sigma = 1e-4
    t = np.arange(round(10.0 * grid)) / grid
    rng = np.random.default_rng(7)
    q = np.sin(2.0 * t) + 0.3 * np.sin(5.0 * t) + sigma * rng.standard_normal(t.size)
    own = np.diff(np.floor(t * rate + 1e-9), prepend=-1.0) > 0.0
    read = {"force_1": 0.5 * rng.standard_normal(t.size), "q_1": np.where(own, q, np.nan)}
    rows = np.stack([read[name] for name in sensing.channels], axis=1)
    for times, block in zip(np.array_split(t, 40), np.array_split(rows, 40), strict=True):
        estimate.push(times, block)
    assert estimate.ready
    rates = {"force_1": grid, "q_1": rate}
    noise = estimate.noise(np.array([1.0 / rates[name] for name in sensing.channels]), sensing.model.system)
    np.testing.assert_allclose(noise.sensors, sigma**2 / rate, rtol=0.3)
    np.testing.assert_allclose(noise.torque, 0.5**2 / grid, rtol=0.3)
    assert not noise.exact
