"""The Cramér–Rao bound: against closed forms, generalised least squares on the whole record, and at its limits."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_online.cramer_rao import DERIVATIVES_INTERVAL, cramer_rao_bound, discretise
from sms_online.description.parse import parse_system, shipped_text
from sms_online.effects.build import build_model
from sms_online.errors import InputError
from sms_online.linearised import Motion, linearise
from sms_online.model.base_parameters import BaseParameters, find_base_parameters, random_states
from sms_online.model.model import Model
from sms_online.model.readings import Readings, readable_channels
from sms_online.model.so3 import from_euler_parameters, logarithm
from sms_online.sensor_set import SensorSet, sensor_set
from sms_online.stream import Array
from sms_sim.plant import Plant
from sms_sim.simulate import exact_states, simulate

TURNTABLE = """
name = "turntable"
motion = "planar"
sample_rate = 500.0

[joint_1]
axis = [0.0, 0.0, 1.0]
transmission = "rigid"

[link_1]
kind = "rigid"
inertia = { zz = 2.0 }
"""
INERTIA = 2.0  # kg m²
RATE = 500.0  # Hz
SIGMA_ANGLE, SIGMA_TORQUE = 1e-3, 0.2  # rad, N m: either noise alone would give a bound a third lower or less


def turntable_motion(t: Array) -> Motion:
    """A table that swings at 3 rad/s, q and q̇ (B, 1), rad and rad/s."""
    q, v = 0.4 * np.sin(3.0 * t) + 0.1 * t, 1.2 * np.cos(3.0 * t) + 0.1
    return Motion(t, q[:, None], v[:, None])


def bound_of_turntable(motions: list[Motion]) -> float:
    model = build_model(parse_system(TURNTABLE, "turntable"))
    base = find_base_parameters(model)
    assert [p.name for p in base.parameters] == ["link_1.inertia"]
    sensors = sensor_set(model, ("force_1", "q_1"), np.array([SIGMA_TORQUE, SIGMA_ANGLE]), np.full(2, RATE))
    return float(cramer_rao_bound(model.dynamics(model.nominal), base, motions, sensors)[0])


def test_a_turntable_meets_its_closed_form() -> None:
    h = 1 / RATE
    t = np.linspace(0.0, 2.0, 1000, endpoint=False)
    motion = turntable_motion(t)
    q, v = motion.x[:, 0], motion.v[0, 0]
    # q(t) = q_0 + q̇_0 t + ∬ τ / I, with the torque's noise held over each step.
    lag = np.arange(t.size)[:, None] - np.arange(t.size)[None]
    response = np.where(lag > 0, h**2 * (lag - 0.5) / INERTIA, 0.0)
    covariance = SIGMA_ANGLE**2 * np.eye(t.size) + SIGMA_TORQUE**2 * response @ response.T
    sensitivity = -(q - q[0] - v * t) / INERTIA
    unknowns = np.column_stack((np.ones(t.size), t, sensitivity))
    information = unknowns.T @ np.linalg.solve(covariance, unknowns)
    bound = bound_of_turntable([turntable_motion(np.linspace(0.0, 2.0, 1001))])
    assert_allclose(bound, np.sqrt(np.linalg.inv(information)[2, 2]), rtol=1e-5)


def test_coarser_steps_state_the_same_bound() -> None:
    fine, coarse = (bound_of_turntable([turntable_motion(np.linspace(0.0, 2.0, n + 1))]) for n in (1000, 200))
    assert_allclose(coarse, fine, rtol=0.01)


def test_informations_of_separate_motions_add_up() -> None:
    first, second = (turntable_motion(np.linspace(start, start + 2.0, 201)) for start in (0.0, 7.0))
    alone = np.array([bound_of_turntable([motion]) for motion in (first, second)])
    assert_allclose(bound_of_turntable([first, second]), np.sum(alone**-2.0) ** -0.5, rtol=1e-9)


def test_instants_without_a_uniform_step_are_refused() -> None:
    with pytest.raises(ValueError, match="uniform step"):
        bound_of_turntable([turntable_motion(np.array([0.0, 0.1, 0.3]))])


# Flexible arms

POSITIONS = [
    *("r_S_x", "r_S_y", "theta_0", "q_1", "q_2", "theta_m_1", "theta_m_2"),
    *(f"link_{i}.marker_{j}.{what}" for i in (1, 2) for j in (1, 2) for what in ("u_y", "theta_z")),
]
WITHOUT_SLOPES = [name for name in POSITIONS if "theta_z" not in name]


def sensors_of(model: Model, channels: list[str]) -> SensorSet:
    """Noise of 1e-4 rad, m and rad/s and 0.5 N m after the gear; encoders, gyro and torques at 1 kHz, others 240 Hz."""
    names = [*channels, "tau_1", "tau_2"]
    sigma = [0.5 / 50.0 if name.startswith("tau") else 1e-4 for name in names]
    rate = [1000.0 if name.startswith(("tau", "q_", "theta_m", "gyro")) else 240.0 for name in names]
    return sensor_set(model, names, np.array(sigma), np.array(rate))


@pytest.fixture(scope="module")
def planar() -> tuple[Model, BaseParameters, Motion]:
    """0.4 s of the paper's example, every 5 ms."""
    simulation = simulate(parse_system(shipped_text("paper-planar"), "paper-planar"), 0.4)
    model, exact = simulation.plant.model, exact_states(simulation, np.linspace(0.0, 0.4, 81))
    return model, find_base_parameters(model), Motion(exact.t, exact.x, exact.v)


def bound_of(planar: tuple[Model, BaseParameters, Motion], channels: list[str]) -> Array:
    model, base, motion = planar
    return cramer_rao_bound(model.dynamics(model.nominal), base, [motion], sensors_of(model, channels))


@pytest.mark.parametrize("channels", [POSITIONS, [*WITHOUT_SLOPES, "gyro_0_z"]], ids=["positions", "rig with a gyro"])
def test_the_planar_bound_is_generalised_least_squares(
    planar: tuple[Model, BaseParameters, Motion], channels: list[str]
) -> None:
    model, base, motion = planar
    sensors, h = sensors_of(model, channels), motion.step
    every = round(DERIVATIVES_INTERVAL / h)
    linear = linearise(
        model.dynamics(model.nominal), base, Readings(model, sensors.channels), motion.x, motion.v, every
    )
    # Readings by [s_0, β] and by the noise of every torque sample, in one matrix.
    A, E = (0.5 * (part[1:] + part[:-1]) for part in (linear.A, linear.E))
    Phi, driven = discretise(A, E, h)
    steps, m, n = Phi.shape[0], Phi.shape[1], base.n
    state = np.concatenate((np.eye(m), np.zeros((m, n + 2 * steps))), axis=1)
    readings = []
    for k in range(steps):
        reading = linear.C[k] @ state
        reading[:, m : m + n] += linear.D[k]
        readings.append(reading / np.sqrt(sensors.density / h)[:, None])
        state = Phi[k] @ state
        state[:, m : m + n] += driven[k, :, 2:]
        state[:, m + n + 2 * k : m + n + 2 * k + 2] += driven[k, :, :2] * np.sqrt(sensors.torque / h)
    whole = np.concatenate(readings)
    unknowns, noise = whole[:, : m + n], whole[:, m + n :]
    whitened = np.linalg.solve(np.linalg.cholesky(np.eye(whole.shape[0]) + noise @ noise.T), unknowns)
    scale = np.linalg.norm(whitened, axis=0)
    R = np.linalg.qr(whitened / scale, mode="r")
    covariance = np.linalg.inv(R) @ np.linalg.inv(R).T
    assert_allclose(bound_of(planar, channels), (np.sqrt(np.diag(covariance)) / scale)[m:], rtol=1e-4)


def test_parameters_that_no_motion_excites_have_no_bound(planar: tuple[Model, BaseParameters, Motion]) -> None:
    model, base, motion = planar
    rest = Motion(motion.t, np.zeros_like(motion.x), np.zeros_like(motion.v))
    bound = cramer_rao_bound(model.dynamics(model.nominal), base, [rest], sensors_of(model, POSITIONS))
    assert np.all(np.isinf(bound))


def test_every_sensor_buys_something_and_none_costs(planar: tuple[Model, BaseParameters, Motion]) -> None:
    everything = bound_of(planar, [*POSITIONS, "gyro_0_z"])
    for left_out in ("gyro_0_z", "link_2.marker_1.theta_z", "theta_m_1"):
        less = bound_of(planar, [name for name in (*POSITIONS, "gyro_0_z") if name != left_out])
        assert (less >= everything * (1.0 - 1e-6)).all()
        assert (less > everything * 1.01).any()


def test_a_fast_sensor_equals_a_slow_one_of_the_same_density(planar: tuple[Model, BaseParameters, Motion]) -> None:
    model, *_ = planar
    names = ("tau_1", "tau_2", "theta_0")
    slow = sensor_set(model, names, np.array([0.01, 0.01, 1e-4]), np.array([1000.0, 1000.0, 250.0]))
    fast = sensor_set(model, names, np.array([0.02, 0.01, 2e-4]), np.array([4000.0, 1000.0, 1000.0]))
    assert_allclose(slow.density, fast.density)
    assert_allclose(slow.torque, fast.torque)
    assert_allclose(slow.torque, np.full(2, 0.5**2 / 1000.0))


def test_a_sensor_set_names_what_is_missing(planar: tuple[Model, BaseParameters, Motion]) -> None:
    model, *_ = planar
    one = np.ones(2)
    with pytest.raises(InputError, match="'tau_2'"):
        sensor_set(model, ("tau_1", "q_1"), one, one)
    with pytest.raises(InputError, match=r"'tau_2'.*no noise is stated"):
        sensor_set(model, ("tau_1", "tau_2"), np.array([1.0, 0.0]), one)
    with pytest.raises(InputError, match=r"'link_1\.strain_angle'"):
        Readings(model, ["link_1.strain_angle"])


@pytest.fixture(scope="module")
def spatial() -> tuple[Model, BaseParameters, Array, Array]:
    """Random states of the spatial arm."""
    model = build_model(parse_system(shipped_text("spatial-two-link"), "spatial-two-link"))
    x, v = random_states(model, 4, np.random.default_rng(7))
    return model, find_base_parameters(model), x, v


def moved(model: Model, x: Array, small: Array) -> Array:
    """Positions x (B, n_x) moved by small rotations and displacements (B, n_v)."""
    return x + model.position_rate(x, small)


def test_the_linearisation_predicts_a_moved_spatial_arm(
    spatial: tuple[Model, BaseParameters, Array, Array],
) -> None:
    model, base, x, v = spatial
    rng = np.random.default_rng(8)
    beta = base.values(model.nominal)
    readings = Readings(model, readable_channels(model))
    linear = linearise(model.dynamics(model.nominal), base, readings, x, v)
    torque, dx, dv, d_beta = (
        1e-6 * rng.standard_normal(shape) for shape in ((x.shape[0], 2), v.shape, v.shape, beta.shape)
    )

    def at_shifted(sign: float) -> tuple[Array, Array, Array]:
        """Momentum, its rate and the readings."""
        at = moved(model, x, sign * dx), v + sign * dv
        P, G = model.momentum_columns(*at)
        pi = base.physical_values(beta + sign * d_beta)
        return P @ pi, G @ pi + model.generalized_force(sign * torque), readings(*at)

    dp, force, reading = (0.5 * (plus - minus) for plus, minus in zip(at_shifted(1.0), at_shifted(-1.0), strict=True))
    s = np.concatenate((dx, dp), axis=1)
    u = np.concatenate((torque, np.broadcast_to(d_beta, (x.shape[0], base.n))), axis=1)
    s_dot = ((linear.A @ s[..., None]) + (linear.E @ u[..., None]))[..., 0]
    n_v = model.layout.n_v
    assert_allclose(s_dot[:, n_v:], force, rtol=1e-5, atol=1e-6 * np.abs(force).max())
    speeds = s_dot[:, :n_v].copy()
    speeds[:, 3:6] -= np.cross(v[:, 3:6], dx[:, 3:6])  # φ̇ = δω + ω × φ
    # As momenta: a difference of momenta gives the speeds of light nodes to a thousandth, of the base to 1e-5.
    H_speeds, H_dv = ((linear.H @ part[..., None])[..., 0] for part in (speeds, dv))
    assert_allclose(H_speeds, H_dv, rtol=1e-5, atol=1e-6 * np.abs(H_dv).max())
    predicted = (linear.C @ s[..., None])[..., 0] + linear.D @ d_beta
    assert_allclose(predicted, reading, rtol=1e-5, atol=1e-4 * np.abs(reading).max())


def test_the_linearisation_carries_a_small_rotation_of_the_base(
    spatial: tuple[Model, BaseParameters, Array, Array],
) -> None:
    model, base, x, v = spatial
    linear = linearise(model.dynamics(model.nominal), base, Readings(model, ["eta"]), x, v)
    rng = np.random.default_rng(9)
    dx, dv = 1e-4 * rng.standard_normal((2, x.shape[0], model.layout.n_v))
    H = model.dynamics(model.nominal).mass_matrix(x)
    at_rest = np.zeros_like(dx)
    dt = 1e-4

    def rotation_between(x: Array, moved_x: Array) -> Array:
        R, moved_R = (from_euler_parameters(y[:, 3:6], y[:, 6]) for y in (x, moved_x))
        return logarithm(moved_R @ R.transpose(0, 2, 1))

    def after(x: Array, v: Array, time: float) -> Array:
        return x + time * model.position_rate(x, v)

    # The attitude alone: what other displacements do to the speeds is another test's.
    at_rest[:, 3:6] = dx[:, 3:6]
    other = moved(model, x, at_rest)
    # δp that leaves δv as chosen: p = H v.
    dp = (model.dynamics(model.nominal).mass_matrix(other) @ (v + dv)[..., None] - H @ v[..., None])[..., 0]
    change = rotation_between(after(x, v, dt), after(other, v + dv, dt)) - rotation_between(
        after(x, v, -dt), after(other, v + dv, -dt)
    )
    expected = (linear.A @ np.concatenate((at_rest, dp), axis=1)[..., None])[:, 3:6, 0]
    assert_allclose(change / (2 * dt), expected, rtol=0, atol=1e-3 * np.abs(expected).max())


def test_a_gyro_reads_the_rate_of_the_base_in_its_own_axes(spatial: tuple[Model, BaseParameters, Array, Array]) -> None:
    model, _, x, v = spatial
    R = from_euler_parameters(x[:, 3:6], x[:, 6])
    gyro = Readings(model, [f"gyro_0_{axis}" for axis in "xyz"])(x, v)
    assert_allclose((R @ gyro[..., None])[..., 0], v[:, 3:6], atol=1e-14)


def test_a_step_of_a_stiff_system_is_its_matrix_exponential() -> None:
    stiffness, damping, h = 4e6, 8500.0, 5e-3
    A = np.array([[[0.0, 1.0], [-stiffness, -damping]]])
    Phi, D = discretise(A, np.array([[[0.0], [1.0]]]), h)
    poles = np.roots([1.0, damping, stiffness])
    # Free motion from a displacement, and the response to a unit force held over the step.
    position = (poles[1] * np.exp(poles[0] * h) - poles[0] * np.exp(poles[1] * h)) / (poles[1] - poles[0])
    assert_allclose(Phi[0, 0, 0], position, rtol=1e-9)
    assert_allclose(D[0, 0, 0], (1.0 - position) / stiffness, rtol=1e-9)


def test_readings_of_an_exact_link_are_its_markers() -> None:
    plant = Plant(parse_system(shipped_text("paper-planar-exact"), "paper-planar-exact"))
    x, v = random_states(plant.model, 3, np.random.default_rng(11))
    readings = Readings(plant.model, plant.channels[2:])(x, v)
    assert_allclose(readings, plant.channel_values(np.zeros((3, 2)), x)[:, 2:], rtol=0, atol=1e-12)
