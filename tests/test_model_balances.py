"""Energies, momenta and equations of motion of the model agree with one another, as mechanics demands."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.model.model import Model
from sms_online.stream import Array
from tests.model_systems import SYSTEMS, difference, move, paper, random_states, spatial

all_systems = pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS.keys())


def along(model: Model, x: Array, v: Array, a: Array, f: Callable[[Array, Array], Array]) -> Array:
    """df/dt of f(x, v) while the system moves with v̇ = a."""
    return difference(lambda t: f(*move(model, x, v, a, t)))


def close(found: Array, expected: Array, tolerance: float) -> None:
    """Equal within `tolerance` of the largest entry."""
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=tolerance * np.abs(expected).max())


@all_systems
def test_energy_columns_give_kinetic_and_potential_energy(system: System) -> None:
    model = build_model(system)
    x, v = random_states(model.layout, 20, seed=1)
    H = model.dynamics(model.nominal).mass_matrix(x)
    K = 0.5 * np.einsum("bi,bij,bj->b", v, H, v)
    U = model.energy_columns(x, 0.0 * v) @ model.nominal
    np.testing.assert_allclose(model.energy_columns(x, v) @ model.nominal, K + U, rtol=1e-10)


@all_systems
def test_mass_matrix_is_symmetric_and_positive_definite(system: System) -> None:
    model = build_model(system)
    x, v = random_states(model.layout, 20, seed=2)
    dynamics = model.dynamics(model.nominal)
    H = dynamics.mass_matrix(x)
    close(H, H.transpose(0, 2, 1), 1e-14)
    assert np.linalg.eigvalsh(H).min() > 0.0
    close(dynamics.mass_and_bias(x, v)[0], H, 1e-14)


@all_systems
def test_momentum_columns_are_mass_matrix_times_speeds(system: System) -> None:
    model = build_model(system)
    x, v = random_states(model.layout, 20, seed=3)
    P, _ = model.momentum_columns(x, v)
    H = model.dynamics(model.nominal).mass_matrix(x)
    close(P @ model.nominal, (H @ v[..., None])[..., 0], 1e-12)


@all_systems
def test_change_of_momentum_is_the_equation_of_motion(system: System) -> None:
    """d/dt(P π) - G π = H v̇ + C, row by row, whatever the acceleration."""
    model = build_model(system)
    x, v = random_states(model.layout, 4, seed=4)
    a = np.random.default_rng(5).normal(size=v.shape)
    P_rate = along(model, x, v, a, lambda x, v: model.momentum_columns(x, v)[0] @ model.nominal)
    G = model.momentum_columns(x, v)[1]
    H, C = model.dynamics(model.nominal).mass_and_bias(x, v)
    close(P_rate - G @ model.nominal, (H @ a[..., None])[..., 0] + C, 1e-9)


@all_systems
def test_power_is_the_change_of_energy_plus_dissipation(system: System) -> None:
    model = build_model(system)
    x, v = random_states(model.layout, 4, seed=6)
    a = np.random.default_rng(7).normal(size=v.shape)
    dynamics = model.dynamics(model.nominal)
    H, C = dynamics.mass_and_bias(x, v)
    Q = (H @ a[..., None])[..., 0] + C
    E_rate = along(model, x, v, a, dynamics.energy)
    close(np.einsum("bi,bi->b", Q, v), E_rate + dynamics.dissipation_power(x, v), 1e-9)


@all_systems
def test_acceleration_solves_the_equations_of_motion(system: System) -> None:
    model = build_model(system)
    x, v = random_states(model.layout, 5, seed=8)
    Q = model.generalized_force(np.random.default_rng(9).normal(size=(5, len(system.joints))))
    dynamics = model.dynamics(model.nominal)
    H, C = dynamics.mass_and_bias(x, v)
    close((H @ dynamics.acceleration(x, v, Q)[..., None])[..., 0], Q - C, 1e-10)


@all_systems
def test_some_rows_are_those_rows_of_all(system: System) -> None:
    model = build_model(system)
    layout = model.layout
    x, v = random_states(layout, 6, seed=10)
    P, G = model.momentum_columns(x, v)
    base, link_1 = range(layout.n_base_speeds), range(layout.q_f[0].start, layout.q_f[0].stop)
    mixed = (layout.n_v - 1, layout.q[1], layout.theta_m[1])
    for rows in (layout.theta_m, layout.theta_m[:1], layout.q[:1], list(base), list(link_1), mixed):
        if rows:
            P_rows, G_rows = model.momentum_columns(x, v, rows)
            close(P_rows, P[:, rows], 1e-13)
            close(G_rows, G[:, rows], 1e-13)


@all_systems
def test_each_sample_of_a_block_is_computed_alone(system: System) -> None:
    model = build_model(system)
    x, v = random_states(model.layout, 9, seed=11)
    E, (P, G) = model.energy_columns(x, v), model.momentum_columns(x, v)
    for b in (0, 4, 8):
        one = slice(b, b + 1)
        close(model.energy_columns(x[one], v[one]), E[one], 1e-13)
        close(model.momentum_columns(x[one], v[one])[0], P[one], 1e-13)
        close(model.momentum_columns(x[one], v[one])[1], G[one], 1e-13)


@all_systems
def test_columns_of_some_parameters_are_those_of_all(system: System) -> None:
    model = build_model(system)
    x, v = random_states(model.layout, 6, seed=13)
    wanted = model.inertial[1::2]
    others = [k for k in model.inertial if k not in wanted]
    flexible = {k for link in model.links for k in link.parameters}  # a link's columns come together
    for some, every in zip(
        model.of_parameters(wanted).momentum_columns(x, v), model.momentum_columns(x, v), strict=True
    ):
        close(some[..., wanted], every[..., wanted], 1e-13)
        assert not some[..., [k for k in others if k not in flexible]].any()


def test_internal_forces_leave_the_base_rows_clean() -> None:
    """Springs, dampers and friction act between the base's bodies: the base's momentum balance does not hold them."""
    model = build_model(SYSTEMS["planar linear"])
    x, v = random_states(model.layout, 10, seed=12)
    P, G = model.momentum_columns(x, v, range(model.layout.n_base_speeds))
    internal = [
        k
        for k, p in enumerate(model.parameters)
        if p.quantity in {"stiffness", "damping", "flexural_rigidity", "torque"}
    ]
    assert len(internal) == 9
    assert not P[..., internal].any()
    assert not G[..., internal].any()


def test_rotor_row_holds_only_its_own_joint() -> None:
    """The row of θ_m of a flexible joint holds I_r, k, b and that joint's effects: nothing else."""
    model = build_model(SYSTEMS["planar exact"])
    x, v = random_states(model.layout, 10, seed=13)
    P, G = model.momentum_columns(x, v, [model.layout.theta_m[1]])
    touched = (P != 0.0).any(axis=(0, 1)) | (G != 0.0).any(axis=(0, 1))
    assert {p.name for p, t in zip(model.parameters, touched, strict=True) if t} == {
        "motor_2.rotor_inertia",
        "joint_2.stiffness",
        "joint_2.damping",
        "coulomb_friction@joint_2.torque",
    }


def soften(model: Model) -> Array:
    """Nominal parameters, springs and dampers a hundred times weaker: an explicit integrator copes with these."""
    weak = ("stiffness", "damping", "flexural_rigidity", "torsional_rigidity", "axial_rigidity")
    return np.array([0.01 * p.nominal if p.quantity.startswith(weak) else p.nominal for p in model.parameters])


def free_motion(
    model: Model, pi: Array, torque: Callable[[float], Array], duration: float
) -> tuple[Array, Array, Array, Array]:
    """States x, v along a motion, work of the motors (42) and dissipated energy (24) since its start; seed 14."""
    layout = model.layout
    dynamics = model.dynamics(pi)
    x, v = random_states(layout, 1, seed=14, elastic=0.05)
    v *= 0.3

    def rate(t: float, y: Array) -> Array:
        x, v = y[None, : layout.n_x], y[None, layout.n_x : -2]
        Q = model.generalized_force(torque(t)[None])
        power = np.array([Q[0] @ v[0], dynamics.dissipation_power(x, v)[0]])
        return np.concatenate((model.position_rate(x, v)[0], dynamics.acceleration(x, v, Q)[0], power))

    start = np.concatenate((x[0], v[0], [0.0, 0.0]))
    y = solve_ivp(rate, (0.0, duration), start, method="DOP853", rtol=1e-9, atol=1e-10).y.T
    return y[:, : layout.n_x], y[:, layout.n_x : -2], y[:, -2], y[:, -1]


@pytest.mark.parametrize("kinematics", ["linear", "exact"])
def test_work_of_the_motors_is_the_change_of_energy(kinematics: str) -> None:
    """(43): work = change of K + U, plus what the dampers take."""
    model = build_model(paper(kinematics))
    pi = soften(model)
    x, v, work, dissipated = free_motion(model, pi, lambda t: 40.0 * np.cos([9.0 * t, 7.0 * t]), 0.3)
    E = model.energy_columns(x, v) @ pi
    assert dissipated[-1] > 0.01 * np.ptp(E)
    np.testing.assert_allclose(work - dissipated, E - E[0], rtol=0.0, atol=1e-7 * np.ptp(E))


FREE_FLOATERS = (paper("exact"), spatial("linear").model_copy(update={"gravity": (0.0, 0.0, 0.0), "effects": ()}))


@pytest.mark.parametrize("system", FREE_FLOATERS, ids=("planar", "spatial"))
def test_momentum_of_a_free_floating_system_is_conserved(system: System) -> None:
    """Motors move the arm; linear momentum and angular momentum about the origin stay."""
    model = build_model(system)
    pi = soften(model)
    torque = np.linspace(30.0, -20.0, len(system.joints))
    x, v, _, _ = free_motion(model, pi, lambda t: torque * np.cos(20.0 * t), 0.1)
    layout = model.layout
    momentum = model.dynamics(pi).base_momentum(x, v)
    n = len(layout.base_linear)
    linear, about_S = momentum[:, :n], momentum[:, n:]
    lever = np.cross(layout.base_pose(x)[0], np.pad(linear, ((0, 0), (0, 3 - n))))
    angular = about_S + lever[:, list(layout.base_angular)]
    size = np.abs(momentum).max()
    assert np.ptp(about_S) > 0.01 * size
    np.testing.assert_allclose(linear, np.broadcast_to(linear[0], linear.shape), rtol=0.0, atol=1e-8 * size)
    np.testing.assert_allclose(angular, np.broadcast_to(angular[0], angular.shape), rtol=0.0, atol=1e-8 * size)
