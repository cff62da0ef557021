"""The Cramér–Rao bound: against closed forms, generalised least squares on the whole record, and at its limits."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_online.bound import cramer_rao_bound, discretise, inverse_dynamics_columns, linearise
from sms_online.description.parse import parse_system, shipped_text
from sms_online.model.base_parameters import BaseParameters, find_base_parameters, random_states
from sms_online.model.model import Model
from sms_online.model.so3 import from_euler_parameters, logarithm
from sms_online.stream import Array
from sms_sim.plant import Plant
from sms_sim.simulate import ExactStates, exact_states, simulate

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
SIGMA_ANGLE, SIGMA_TORQUE = 1e-3, 0.2  # rad, N m: either noise alone would give a bound a third lower or less


def turntable_motion(t: Array) -> tuple[Array, Array, Array]:
    """q, q̇ and torque (B, 1) of a table that swings at 3 rad/s."""
    q, v = 0.4 * np.sin(3.0 * t) + 0.1 * t, 1.2 * np.cos(3.0 * t) + 0.1
    return q[:, None], v[:, None], -INERTIA * 9.0 * 0.4 * np.sin(3.0 * t)[:, None]


def bound_of_turntable(t: Array) -> float:
    model = Model(parse_system(TURNTABLE, "turntable"))
    base = find_base_parameters(model)
    assert [p.name for p in base.parameters] == ["link_1.inertia"]
    noise = np.array([SIGMA_ANGLE]), np.array([SIGMA_TORQUE])
    return float(cramer_rao_bound(model.dynamics(model.nominal), base, t, *turntable_motion(t), *noise)[0])


def test_a_turntable_meets_the_closed_form_of_its_double_integral() -> None:
    h = 1 / 500
    t = np.linspace(0.0, 2.0, 1000, endpoint=False)
    q, v, _ = turntable_motion(t)
    # q(t) = q_0 + q̇_0 t + ∬ τ / I, with the torque's noise held over each step.
    lag = np.arange(t.size)[:, None] - np.arange(t.size)[None]
    response = np.where(lag > 0, h**2 * (lag - 0.5) / INERTIA, 0.0)
    covariance = SIGMA_ANGLE**2 * np.eye(t.size) + SIGMA_TORQUE**2 * response @ response.T
    sensitivity = -(q[:, 0] - q[0] - v[0] * t) / INERTIA
    unknowns = np.column_stack((np.ones(t.size), t, sensitivity))
    information = unknowns.T @ np.linalg.solve(covariance, unknowns)
    bound = bound_of_turntable(np.linspace(0.0, 2.0, 1001))
    assert_allclose(bound, np.sqrt(np.linalg.inv(information)[2, 2]), rtol=1e-5)


def test_coarser_steps_state_the_same_bound() -> None:
    fine, coarse = (bound_of_turntable(np.linspace(0.0, 2.0, steps + 1)) for steps in (1000, 200))
    assert_allclose(coarse, fine, rtol=0.01)


# Flexible arms


@pytest.fixture(scope="module")
def planar() -> tuple[Model, BaseParameters, ExactStates]:
    """0.4 s of the paper's example, every 5 ms."""
    simulation = simulate(parse_system(shipped_text("paper-planar"), "paper-planar"), 0.4)
    model = simulation.plant.model
    return model, find_base_parameters(model), exact_states(simulation, np.linspace(0.0, 0.4, 81))


def test_the_planar_arm_meets_generalised_least_squares_on_the_whole_record(
    planar: tuple[Model, BaseParameters, ExactStates],
) -> None:
    model, base, exact = planar
    sigma_x, sigma_tau = np.full(model.layout.n_x, 1e-4), np.full(2, 0.5)
    dynamics = model.dynamics(model.nominal)
    bound = cramer_rao_bound(dynamics, base, exact.t, exact.x, exact.v, exact.torque, sigma_x, sigma_tau)
    # Readings by [s_0, β] and by the noise of every torque sample, in one matrix. Five samples of 1 ms are one of 5 ms.
    linear = linearise(dynamics, base, exact.x, exact.v, exact.torque)
    A, E = (0.5 * (part[1:] + part[:-1]) for part in (linear.A, linear.E))
    Phi, D = discretise(A, E, 5e-3)
    steps, m, n = Phi.shape[0], Phi.shape[1], base.n
    state = np.concatenate((np.eye(m), np.zeros((m, n + 2 * steps))), axis=1)
    readings = []
    for k in range(steps):
        readings.append(linear.C[k] @ state / sigma_x[:, None])
        state = Phi[k] @ state
        state[:, m : m + n] += D[k, :, 2:]
        state[:, m + n + 2 * k : m + n + 2 * k + 2] += D[k, :, :2] * sigma_tau
    whole = np.concatenate(readings) * np.sqrt(5.0)
    unknowns, noise = whole[:, : m + n], whole[:, m + n :] / np.sqrt(5.0)
    whitened = np.linalg.solve(np.linalg.cholesky(np.eye(whole.shape[0]) + noise @ noise.T), unknowns)
    scale = np.linalg.norm(whitened, axis=0)
    R = np.linalg.qr(whitened / scale, mode="r")
    covariance = np.linalg.inv(R) @ np.linalg.inv(R).T
    assert_allclose(bound, (np.sqrt(np.diag(covariance)) / scale)[m:], rtol=1e-4)


def test_parameters_that_no_motion_excites_have_no_bound(planar: tuple[Model, BaseParameters, ExactStates]) -> None:
    model, base, exact = planar
    x, v, torque = (np.zeros_like(values) for values in (exact.x, exact.v, exact.torque))
    sigma_x, sigma_tau = np.full(model.layout.n_x, 1e-4), np.full(2, 0.5)
    bound = cramer_rao_bound(model.dynamics(model.nominal), base, exact.t, x, v, torque, sigma_x, sigma_tau)
    assert np.all(np.isinf(bound))


@pytest.fixture(scope="module")
def spatial() -> tuple[Model, BaseParameters, Array, Array, Array]:
    """Random states and torques of the spatial arm."""
    model = Model(parse_system(shipped_text("spatial-two-link"), "spatial-two-link"))
    rng = np.random.default_rng(7)
    x, v = random_states(model, 4, rng)
    return model, find_base_parameters(model), x, v, rng.normal(scale=100.0, size=(4, 2))


def moved(model: Model, x: Array, small: Array) -> Array:
    """Positions x (B, n_x) moved by small rotations and displacements (B, n_v)."""
    return x + model.position_rate(x, small)


def test_the_linearisation_predicts_accelerations_of_a_moved_spatial_arm(
    spatial: tuple[Model, BaseParameters, Array, Array, Array],
) -> None:
    model, base, x, v, torque = spatial
    rng = np.random.default_rng(8)
    beta = base.values(model.nominal)
    linear = linearise(model.dynamics(model.nominal), base, x, v, torque)
    direction = [1e-6 * rng.standard_normal(part.shape) for part in (v, v, torque, beta)]

    def acceleration(sign: float) -> Array:
        dx, dv, d_torque, d_beta = (sign * part for part in direction)
        dynamics = model.dynamics(base.physical_values(beta + d_beta))
        return dynamics.acceleration(moved(model, x, dx), v + dv, model.generalized_force(torque + d_torque))

    expected = 0.5 * (acceleration(1.0) - acceleration(-1.0))
    s = np.concatenate(direction[:2], axis=1)
    u = np.concatenate((direction[2], np.broadcast_to(direction[3], (x.shape[0], base.n))), axis=1)
    s_dot = ((linear.A @ s[..., None]) + (linear.E @ u[..., None]))[..., 0]
    assert_allclose(s_dot[:, model.layout.n_v :], expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())


def test_the_linearisation_carries_a_small_rotation_of_the_base_with_its_spin(
    spatial: tuple[Model, BaseParameters, Array, Array, Array],
) -> None:
    model, base, x, v, torque = spatial
    linear = linearise(model.dynamics(model.nominal), base, x, v, torque)
    rng = np.random.default_rng(9)
    s = 1e-4 * rng.standard_normal((x.shape[0], 2 * model.layout.n_v))
    dx, dv = np.split(s, 2, axis=1)
    dt = 1e-4

    def rotation_between(x: Array, moved_x: Array) -> Array:
        R, moved_R = (from_euler_parameters(y[:, 3:6], y[:, 6]) for y in (x, moved_x))
        return logarithm(moved_R @ R.transpose(0, 2, 1))

    def after(x: Array, v: Array, time: float) -> Array:
        return x + time * model.position_rate(x, v)

    other = moved(model, x, dx)
    change = rotation_between(after(x, v, dt), after(other, v + dv, dt)) - rotation_between(
        after(x, v, -dt), after(other, v + dv, -dt)
    )
    expected = (linear.A @ s[..., None])[:, 3:6, 0]
    assert_allclose(change / (2 * dt), expected, rtol=0, atol=1e-3 * np.abs(expected).max())


def test_columns_of_inverse_dynamics_add_up_to_the_equations_of_motion(
    spatial: tuple[Model, BaseParameters, Array, Array, Array],
) -> None:
    model, _, x, v, _ = spatial
    a = np.random.default_rng(10).standard_normal(v.shape)
    H, C = model.dynamics(model.nominal).mass_and_bias(x, v)
    expected = (H @ a[..., None])[..., 0] + C
    columns = inverse_dynamics_columns(model, x, v, a)
    assert_allclose(columns @ model.nominal, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


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
    model = plant.model
    rng = np.random.default_rng(11)
    x, v = random_states(model, 3, rng)
    none = np.zeros((3, 2))
    linear = linearise(model.dynamics(model.nominal), find_base_parameters(model), x, v, none)
    dx = 1e-6 * rng.standard_normal(v.shape)
    readings = [plant.channel_values(none, moved(model, x, sign * dx))[:, 2:] for sign in (1.0, -1.0)]
    expected = 0.5 * (readings[0] - readings[1])
    s = np.concatenate((dx, np.zeros_like(v)), axis=1)
    assert_allclose((linear.C @ s[..., None])[..., 0], expected, rtol=0, atol=1e-12)
