"""Rotations and the kinematic map of the base."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sms_online.effects.build import build_model
from sms_online.model import so3
from sms_online.model.layout import build_layout
from tests.model_systems import difference, random_states, spatial


def test_exponential_and_logarithm_up_to_half_a_turn() -> None:
    rng = np.random.default_rng(70)
    axes = rng.normal(size=(60, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    theta = axes * np.concatenate(([0.0, 1e-12, 1e-9, 1e-7, 1e-5], np.linspace(1e-3, 3.14, 55)))[:, None]
    R = so3.RotationVector(theta).matrix
    np.testing.assert_allclose(R, Rotation.from_rotvec(theta).as_matrix(), atol=1e-14)
    # Towards half a turn the sine of the angle loses what the angle is from π.
    np.testing.assert_allclose(so3.logarithm(R), theta, rtol=0.0, atol=1e-12)


def test_left_jacobian_turns_rates_into_angular_velocity() -> None:
    """d/dt exp(θ×) = (J_l θ̇)× exp(θ×), and the rate of J_l is its difference."""
    rng = np.random.default_rng(71)
    theta, rate = rng.uniform(-1.5, 1.5, size=(8, 3)), rng.normal(size=(8, 3))
    turn = so3.RotationVector(theta)
    R_rate = difference(lambda t: so3.RotationVector(theta + t * rate).matrix)
    omega = (turn.left_jacobian @ rate[..., None])[..., 0]
    np.testing.assert_allclose(so3.skew(omega) @ turn.matrix, R_rate, atol=1e-11)
    J_rate = difference(lambda t: so3.RotationVector(theta + t * rate).left_jacobian)
    np.testing.assert_allclose(turn.left_jacobian_rate(rate), J_rate, atol=1e-11)


def test_skew_is_the_cross_product() -> None:
    a, b = np.random.default_rng(72).normal(size=(2, 7, 3))
    np.testing.assert_allclose((so3.skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)
    np.testing.assert_allclose(so3.cross(a, b), np.cross(a, b), atol=1e-15)


def test_turns_about_an_axis() -> None:
    axis, angles = np.array([0.0, 0.6, 0.8]), np.linspace(-9.0, 9.0, 13)
    expected = Rotation.from_rotvec(angles[:, None] * axis).as_matrix()
    np.testing.assert_allclose(so3.about(so3.turn_basis(axis), angles), expected, atol=1e-14)


def test_euler_parameters_and_their_negative_are_one_attitude() -> None:
    """As is any multiple of them; their rate belongs to the inertial angular velocity, of the same sign."""
    rng = np.random.default_rng(73)
    e = rng.normal(size=(6, 4))
    omega = rng.normal(size=(6, 3))
    R = so3.from_euler_parameters(e[:, :3], e[:, 3])
    np.testing.assert_allclose(R, Rotation.from_quat(e).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(so3.from_euler_parameters(-2.0 * e[:, :3], -2.0 * e[:, 3]), R, atol=1e-14)
    rate = so3.euler_parameter_rate(e[:, :3], e[:, 3], omega)
    np.testing.assert_allclose(so3.angular_velocity(e[:, :3], e[:, 3], rate), omega, atol=1e-13)
    np.testing.assert_allclose(so3.angular_velocity(-e[:, :3], -e[:, 3], -rate), omega, atol=1e-13)
    h = 1e-5
    ahead, behind = (Rotation.from_quat(e + s * h * rate).as_matrix() for s in (1.0, -1.0))
    np.testing.assert_allclose((ahead - behind) / (2.0 * h), so3.skew(omega) @ R, atol=1e-8)


def test_speeds_and_position_rates_are_inverse_maps() -> None:
    layout = build_layout(spatial())
    x, v = random_states(layout, 10, seed=74)
    np.testing.assert_allclose(layout.speeds(x, layout.position_rate(x, v)), v, atol=1e-13)
    assert layout.n_x == layout.n_v + 1


def test_turning_the_world_changes_no_inertia() -> None:
    """A rotation of everything, base and speeds alike, leaves the energy of a weightless system as it was."""
    model = build_model(spatial("exact").model_copy(update={"gravity": (0.0, 0.0, 0.0)}))
    x, v = random_states(model.layout, 5, seed=75)
    world = Rotation.from_rotvec([0.4, -1.1, 0.7])
    turned_x, turned_v = x.copy(), v.copy()
    turned_x[:, :3] = world.apply(x[:, :3]) + np.array([3.0, -2.0, 1.0])
    turned_x[:, 3:7] = (world * Rotation.from_quat(x[:, 3:7])).as_quat()
    turned_v[:, :3], turned_v[:, 3:6] = world.apply(v[:, :3]), world.apply(v[:, 3:6])
    Y = model.energy_columns(x, v)
    np.testing.assert_allclose(model.energy_columns(turned_x, turned_v), Y, rtol=0.0, atol=1e-12 * np.abs(Y).max())
