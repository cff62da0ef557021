"""Parts of the smoother: static shapes, collocation, and the filter against one dense least-squares problem."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_adapters.system_file import load_system
from sms_online.effects.build import build_model
from sms_online.errors import InputError
from sms_online.linearised import Motion
from sms_online.model.model import Model
from sms_online.model.static_shape import SensedShape
from sms_online.pipeline.sensing import Sensing
from sms_online.smoother.averaging import averaged
from sms_online.smoother.collocation import Transitions, defects
from sms_online.smoother.filter import FixedIntervalSmoother
from sms_online.stream import Array
from sms_online.trackers.factor import solve, triangular_factor
from sms_sim.simulate import Simulation, exact_states, simulate
from tests.one_link import one_link

DISPLACEMENTS = [0, 2]  # of the two markers' u_y, theta_z


@pytest.fixture(scope="module", params=["linear", "exact"])
def model(request: pytest.FixtureRequest) -> Model:
    return build_model(one_link(request.param))


def test_a_static_shape_is_that_of_a_link_held_at_its_markers(model: Model) -> None:
    kinematics = model.chain.flexible[0]
    assert kinematics is not None
    (K,) = kinematics.stiffness.values()
    readings = np.array([[0.02, 0.07], [-0.05, 0.03]])
    q_f = SensedShape(kinematics, DISPLACEMENTS).coordinates(readings)
    assert_allclose(kinematics.markers(q_f)[:, DISPLACEMENTS], readings, atol=1e-12)
    # The link's forces K q_f are those of two holders, which act along the readings alone.
    held = kinematics.marker_jacobian(q_f)[:, DISPLACEMENTS]
    for force, along in zip(q_f @ K, held, strict=True):
        holders = np.linalg.lstsq(along.T, force, rcond=None)[0]
        assert_allclose(along.T @ holders, force, atol=1e-9 * np.abs(force).max())


def test_slopes_of_a_cantilever_follow_from_displacements() -> None:
    kinematics = build_model(one_link("linear")).chain.flexible[0]
    assert kinematics is not None
    # u = a (3 L s² - s³) of a load at the tip, L = 1 m.
    s, a = np.array([0.5, 1.0]), 0.01
    u, slope = a * (3.0 * s**2 - s**3), a * (6.0 * s - 3.0 * s**2)
    q_f = SensedShape(kinematics, DISPLACEMENTS).coordinates(u[None])
    assert_allclose(kinematics.markers(q_f)[0, [1, 3]], slope, rtol=1e-12)


def test_a_shape_with_all_readings_is_the_one_that_is_read(model: Model) -> None:
    kinematics = model.chain.flexible[0]
    assert kinematics is not None
    q_f = np.random.default_rng(3).uniform(-0.1, 0.1, (4, kinematics.n_f))
    assert_allclose(SensedShape(kinematics, range(4)).coordinates(kinematics.markers(q_f)), q_f, atol=1e-12)


def test_a_link_without_any_marker_is_refused(model: Model) -> None:
    drives = ("tau_1", "theta_m_1", "q_1")
    with pytest.raises(InputError, match=r"'link_1\.marker_1\.u_"):
        Sensing(model, drives, "capture")
    sensing = Sensing(model, (*drives, "link_1.marker_2.u_y"), "capture")
    assert "link_1.marker_2.theta_z" in sensing.missing
    assert "link_1.marker_2.u_y" not in sensing.missing


@pytest.fixture(scope="module", params=["one link", "spatial free base"])
def simulation(request: pytest.FixtureRequest) -> Simulation:
    return simulate(one_link("linear") if request.param == "one link" else load_system("spatial-two-link"), 1.0)


def test_an_exact_motion_meets_the_collocation_to_its_order(simulation: Simulation) -> None:
    plant = simulation.plant

    def rms(step: float) -> Array:
        # After the jolt of the start, whose stiff part no step of milliseconds follows.
        t = 0.5 + step * np.arange(round(0.4 / step) + 1)
        exact = exact_states(simulation, t)
        # Impulses of the torques from the start on, by Simpson's rule on a fine grid.
        fine = np.linspace(t[0], t[-1], 8 * (t.size - 1) + 1)
        torque = exact_states(simulation, fine).torque
        pair = (fine[1] - fine[0]) / 3.0 * (torque[:-2:2] + 4.0 * torque[1:-1:2] + torque[2::2])
        impulse = np.concatenate((np.zeros((1, pair.shape[1])), np.cumsum(pair, axis=0)))[::2]
        force = plant.model.generalized_force
        lacking = defects(plant.dynamics, Motion(t, exact.x, exact.v), force(impulse[::2]), force(impulse[1::2]))
        return np.array([np.sqrt(np.mean(part**2)) for part in np.split(lacking, 2, axis=1)])

    # A step errs with the fifth power of its length, in positions and in momenta.
    ratio = rms(0.0025) / rms(0.00125)
    assert np.all(ratio > 24.0)
    assert np.all(ratio < 40.0)


def dense_problem(steps: Transitions, root: Array, C: Array, D: Array, e: Array) -> tuple[Array, Array]:
    """Rows of unit variance for [s_0, w, δβ] and their right sides: prior, noise and samples below each other."""
    K, m, noises = steps.Gamma.shape
    n = D.shape[2]
    width = m + K * noises + n
    # States as affine functions of the unknowns.
    state, offset = np.zeros((K + 1, m, width)), np.zeros((K + 1, m))
    state[0, :, :m] = np.eye(m)
    for k in range(K):
        state[k + 1] = steps.Phi[k] @ state[k]
        state[k + 1, :, m + k * noises : m + (k + 1) * noises] += steps.Gamma[k]
        state[k + 1, :, m + K * noises :] += steps.B[k]
        offset[k + 1] = steps.Phi[k] @ offset[k] + steps.d[k]
    rows = C @ state
    rows[:, :, m + K * noises :] += D
    right = e - (C @ offset[..., None])[..., 0]
    prior = np.zeros((m + K * noises, width))
    prior[:m, :m], prior[m:, m : m + K * noises] = np.linalg.inv(root.T), np.eye(K * noises)
    solution = np.linalg.lstsq(
        np.concatenate((prior, rows.reshape(-1, width))),
        np.concatenate((np.zeros(len(prior)), right.ravel())),
        rcond=None,
    )[0]
    return solution[m + K * noises :], (state @ solution) + offset


def test_filter_and_smoother_equal_dense_least_squares() -> None:
    rng = np.random.default_rng(5)
    K, m, n, n_y, noises = 12, 4, 2, 3, 1
    steps = Transitions(
        np.eye(m) + 0.2 * rng.standard_normal((K, m, m)), rng.standard_normal((K, m, noises)),
        rng.standard_normal((K, m, n)), rng.standard_normal((K, m)),
    )  # fmt: skip
    C, D = rng.standard_normal((K + 1, n_y, m)), rng.standard_normal((K + 1, n_y, n))
    e = rng.standard_normal((K + 1, n_y))
    missing = rng.random((K + 1, n_y)) < 0.3
    C[missing], D[missing], e[missing] = 0.0, 0.0, 0.0
    root = np.triu(rng.standard_normal((m, m))) + 3.0 * np.eye(m)
    kalman = FixedIntervalSmoother(root.copy(), np.zeros((m, 1 + n)))
    half = Transitions(*(part[:6] for part in (steps.Phi, steps.Gamma, steps.B, steps.d)))
    rest = Transitions(*(part[6:] for part in (steps.Phi, steps.Gamma, steps.B, steps.d)))
    innovations = np.concatenate((kalman.push(e[:6], C[:6], D[:6], half), kalman.push(e[6:], C[6:], D[6:], rest)))
    assert len(innovations) == np.count_nonzero(~missing)
    delta = np.linalg.lstsq(-innovations[:, 1:], innovations[:, 0], rcond=None)[0]
    expected_delta, expected_states = dense_problem(steps, root, C, D, e)
    assert_allclose(delta, expected_delta, rtol=1e-9)
    assert_allclose(kalman.smooth(delta), expected_states, rtol=1e-8, atol=1e-8)
    # Another filter that goes on from the end of a first one loses nothing; samples where they meet are the first's.
    first = FixedIntervalSmoother(root.copy(), np.zeros((m, 1 + n)))
    rows = [first.push(e[:7], C[:7], D[:7], half)]
    second = FixedIntervalSmoother(first.root, first.mean)
    nothing = np.zeros_like(C[:1])
    rows.append(second.push(e[6:], np.concatenate((nothing, C[7:])), D[6:], rest))
    innovations = np.concatenate(rows)
    assert len(innovations) == np.count_nonzero(~missing)
    delta = np.linalg.lstsq(-innovations[:, 1:], innovations[:, 0], rcond=None)[0]
    assert_allclose(delta, expected_delta, rtol=1e-9)
    assert_allclose(second.smooth(expected_delta)[-1], expected_states[-1], rtol=1e-8, atol=1e-8)


def test_minima_that_scatter_widen_the_covariance_by_their_scatter() -> None:
    random = np.random.default_rng(4)
    rows = random.standard_normal((40, 3))
    targets = random.standard_normal((8, 3)) * [0.3, 0.0, 2.0] + [1.0, -2.0, 3.0]
    factor, beta = averaged(triangular_factor(np.column_stack((rows, rows @ targets[0]))), list(targets))
    assert_allclose(beta, targets.mean(axis=0))
    found = solve(factor)
    assert_allclose(found.covariance(), np.linalg.inv(rows.T @ rows) + np.cov(targets.T), rtol=1e-9)
    assert_allclose(factor[:-1, :-1] @ beta, factor[:-1, -1], rtol=1e-9)
