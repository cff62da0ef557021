"""Projection onto physically consistent parameters: against closed forms, brute force and the laws of convexity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
from numpy.testing import assert_allclose

from sms_online.description.parse import parse_system, shipped_text
from sms_online.effects.build import build_model, changed_model
from sms_online.model.base_parameters import BaseParameters, find_base_parameters
from sms_online.model.model import Model
from sms_online.physical import PhysicalSet
from sms_online.pipeline.event_hypotheses import everything, extended
from sms_online.stream import Array

PENDULUM = """
name = "pendulum"
motion = "planar"
gravity = [0.0, -9.81, 0.0]

[joint_1]
axis = [0.0, 0.0, 1.0]
transmission = "rigid"

[link_1]
kind = "rigid"
mass = 2.0
center_of_mass = [0.5, 0.0, 0.0]
inertia = { zz = 0.1 }

[known]
"link_1.mass" = 2.0
"""

Case = tuple[Model, BaseParameters, PhysicalSet]


def case(text: str, name: str) -> Case:
    model = build_model(parse_system(text, name))
    base = find_base_parameters(model)
    return model, base, PhysicalSet(model, base)


@pytest.fixture(scope="module")
def planar() -> Case:
    return case(shipped_text("paper-planar"), "paper-planar")


@pytest.fixture(scope="module")
def spatial() -> Case:
    return case(shipped_text("spatial-two-link"), "spatial-two-link")


def names(base: BaseParameters) -> list[str]:
    return [parameter.name for parameter in base.parameters]


def random_covariance(rng: np.random.Generator, std: Array) -> Array:
    root = rng.standard_normal((std.size, 2 * std.size))
    C = root @ root.T
    return np.asarray(C / np.sqrt(np.outer(np.diag(C), np.diag(C))) * np.outer(std, std))


def test_a_consistent_estimate_is_returned_as_it_is(planar: Case, spatial: Case) -> None:
    rng = np.random.default_rng(1)
    for model, base, physical in (planar, spatial):
        beta = base.values(model.nominal)
        present = np.where(beta == 0.0, 1e-3, np.abs(beta))
        for relative in (1e-6, 1.0):
            projection = physical.project(beta, random_covariance(rng, relative * present))
            assert projection.beta is beta
            assert projection.distance == 0.0
            assert projection.active == ()


def test_a_negative_stiffness_moves_correlated_parameters(planar: Case) -> None:
    model, base, physical = planar
    beta = base.values(model.nominal)
    k = names(base).index("joint_1.stiffness")
    std = 0.01 * np.abs(beta)
    beta[k], std[k] = -30.0, 20.0
    covariance = random_covariance(np.random.default_rng(2), std)
    projection = physical.project(beta, covariance)
    assert projection.active == ("joint_1.stiffness",)
    # Conditioning a normal distribution on one component: the others follow by their regression on it.
    assert_allclose(projection.distance, 1.5, rtol=1e-5)
    expected = beta + covariance[:, k] / covariance[k, k] * 30.0
    assert_allclose(projection.beta, expected, rtol=1e-5, atol=1e-4)
    assert np.abs(expected - beta)[k - 1] > 0.01 * std[k - 1]


def test_the_nearest_pendulum_is_that_of_brute_force() -> None:
    # With the mass m known, I m >= h² is a paraboloid, and the estimate lies outside of it.
    _, base, physical = case(PENDULUM, "pendulum")
    assert names(base) == ["link_1.inertia", "link_1.first_moment_x", "link_1.first_moment_y"]
    rng = np.random.default_rng(3)
    beta = np.array([0.3, 1.0, -0.4])
    covariance = random_covariance(rng, np.array([0.2, 0.1, 0.3]))
    information = np.linalg.inv(covariance)

    def squared_distance(h: Array) -> float:
        """From the paraboloid's point above first moments h."""
        shift = np.array([h @ h / 2.0, *h]) - beta
        return float(shift @ information @ shift)

    best = scipy.optimize.brute(squared_distance, ((-2.0, 2.0), (-2.0, 2.0)), Ns=81)  # a grid, then Nelder-Mead
    projection = physical.project(beta, covariance)
    assert projection.active == ("link_1",)
    assert_allclose(projection.distance, np.sqrt(squared_distance(best)), rtol=1e-5)
    assert_allclose(projection.beta, [best @ best / 2.0, *best], rtol=0, atol=1e-4)


def consistent_pi(model: Model, rng: np.random.Generator) -> Array:
    """Random consistent parameters: clouds of point masses, and positive numbers."""
    pi: Array = np.abs(model.nominal) * rng.uniform(0.0, 2.0, model.n_pi)
    parameters = [parameter.name for parameter in model.parameters]
    for owner in {parameter.owner for parameter in model.parameters}:
        if f"{owner}.first_moment_x" not in parameters:
            continue
        masses, points = rng.exponential(20.0, 5), rng.uniform(-2.0, 2.0, (5, 3))
        if model.layout.planar:
            points[:, 2] = 0.0
        sign = -1.0 if owner == "spacecraft" else 1.0
        second = np.einsum("p,pi,pj->ij", masses, points, points)
        inertia = np.trace(second) * np.eye(3) - second
        for k, parameter in enumerate(model.parameters):
            if parameter.owner != owner:
                continue
            if parameter.quantity == "mass":
                pi[k] = masses.sum()
            elif parameter.quantity.startswith("first_moment"):
                pi[k] = sign * (masses @ points)["xyz".index(parameter.quantity[-1])]
            else:
                axes = "zz" if model.layout.planar else parameter.quantity[-2:]
                pi[k] = inertia["xyz".index(axes[0]), "xyz".index(axes[1])]
    for i in (1, 2):
        if not model.layout.planar:  # a stator's own cloud
            first = parameters.index(f"motor_{i}.stator_inertia_xx")
            points = rng.uniform(-0.1, 0.1, (5, 3))
            second = points.T @ points
            inertia = np.trace(second) * np.eye(3) - second
            pi[first : first + 6] = [
                inertia["xyz".index(a), "xyz".index(b)] for a, b in ("xx", "yy", "zz", "xy", "xz", "yz")
            ]
    return pi


@pytest.mark.parametrize("which", ["planar", "spatial"])
def test_no_consistent_parameters_lie_ahead_of_the_projection(which: str, request: pytest.FixtureRequest) -> None:
    # The plane through the projection, square to the way there, has the whole convex set on its far side.
    model, base, physical = request.getfixturevalue(which)
    rng = np.random.default_rng(4)
    nominal = base.values(model.nominal)
    size = np.where(nominal == 0.0, 1e-2, np.abs(nominal))
    covariance = random_covariance(rng, 0.5 * size)
    estimate = nominal + np.linalg.cholesky(covariance) @ rng.standard_normal(base.n) * 3.0
    projection = physical.project(estimate, covariance)
    assert projection.distance > 1.0
    way = np.linalg.solve(covariance, projection.beta - estimate)
    for _ in range(300):
        other = base.values(consistent_pi(model, rng))
        assert way @ (other - projection.beta) > -1e-3 * projection.distance
    # And the projection is consistent itself.
    again = physical.project(projection.beta, covariance)
    assert again.distance < 1e-2


def test_an_inertia_beyond_the_triangle_inequality_is_found(spatial: Case) -> None:
    model, base, physical = spatial
    beta = base.values(model.nominal)
    xx, yy, zz = (names(base).index(f"payload.inertia_{axis}") for axis in ("xx", "yy", "zz"))
    beta[xx] = beta[yy] + beta[zz] + 1.0
    covariance = np.diag((1e-3 * np.where(beta == 0.0, 1.0, np.abs(beta))) ** 2)
    covariance[[xx, yy, zz], [xx, yy, zz]] = 0.1**2
    projection = physical.project(beta, covariance)
    assert projection.active == ("payload",)
    excess = projection.beta[xx] - projection.beta[yy] - projection.beta[zz]
    assert excess < 1e-4
    # At least the way to the plane I_xx = I_yy + I_zz; a payload off its frame's origin has to go further.
    assert projection.distance >= 1.0 / (0.1 * np.sqrt(3.0)) - 1e-3


def test_a_first_moment_needs_inertia_in_space_too(spatial: Case) -> None:
    model, base, physical = spatial
    beta = base.values(model.nominal)
    h = names(base).index("payload.first_moment_y")
    std = 1e-6 * np.where(beta == 0.0, 1.0, np.abs(beta))
    beta[h], std[h] = 50.0, 1.0
    projection = physical.project(beta, np.diag(std**2))
    assert projection.active == ("payload",)
    # The second moment about the plane y = 0 is the most that h_y²/m can be.
    xx, yy, zz, mass = (
        beta[names(base).index(f"payload.{name}")] for name in ("inertia_xx", "inertia_yy", "inertia_zz", "mass")
    )
    assert projection.beta[h] ** 2 <= mass * 0.5 * (xx + zz - yy) * (1.0 + 1e-3)


def test_bodies_in_combinations_are_found_consistent() -> None:
    # With seven joints a body alone, without what others lend to its combinations, would not be one.
    model, base, physical = case(shipped_text("seven-joint"), "seven-joint")
    assert base.mixture.min() < 0.0
    beta = base.values(model.nominal)
    std = 1e-6 * np.where(beta == 0.0, 1.0, np.abs(beta))
    assert physical.project(beta, np.diag(std**2)).beta is beta
    alone = PhysicalSet(model, replace(base, mixture=np.zeros_like(base.mixture)))
    assert alone.project(beta, np.diag(std**2)).distance > 1.0


def test_what_the_data_do_not_determine_bounds_nothing(planar: Case) -> None:
    model, base, physical = planar
    beta = base.values(model.nominal)
    k = names(base).index("motor_2.mass")
    beta[k] = -5.0
    covariance = np.diag((0.01 * beta) ** 2)
    assert physical.project(beta, covariance).active == ("motor_2.mass",)
    covariance[k, k] = np.inf
    assert physical.project(beta, covariance).beta is beta


def test_a_lumped_mass_is_bounded_by_all_that_it_holds(planar: Case) -> None:
    # The spacecraft's mass with motor 1's: however it is shared out, the spacecraft needs enough for its first moment.
    model, base, physical = planar
    beta = base.values(model.nominal)
    inertia, x, y, mass = (
        names(base).index(f"spacecraft.{name}")
        for name in ("inertia_about_joint_1", "first_moment_x", "first_moment_y", "mass_with_motor_1")
    )
    std = 1e-9 * np.abs(beta)
    least = (beta[x] ** 2 + beta[y] ** 2) / beta[inertia]
    beta[mass], std[mass] = least - 3.0, 1.0
    projection = physical.project(beta, np.diag(std**2))
    assert projection.active == ("spacecraft",)
    assert_allclose(projection.distance, 3.0, rtol=1e-3)
    assert_allclose(projection.beta[mass], least, rtol=1e-4)


def test_declared_values_are_not_questioned() -> None:
    text = PENDULUM.replace("mass = 2.0\ncenter", "mass = 0.0\ncenter").replace(
        '"link_1.mass" = 2.0', '"link_1.mass" = 0.0'
    )
    _, _, physical = case(text, "pendulum")
    beta = np.array([0.1, 1.0, 0.0])
    assert physical.project(beta, np.eye(3)).beta is beta


def test_coefficients_of_effects_may_have_either_sign() -> None:
    model, base, physical = case(shipped_text("emps"), "emps")
    beta = base.values(model.nominal)
    effects = [k for k, name in enumerate(names(base)) if "@" in name]
    assert effects
    beta[effects] *= -1.0
    assert physical.project(beta, np.diag((1e-3 * np.abs(beta) + 1e-9) ** 2)).beta is beta


def test_a_payload_that_is_released_takes_mass_away() -> None:
    """As a change of the last link's body; as a body of its own it would have negative mass."""
    system = parse_system(PENDULUM, "pendulum")
    model = build_model(system)
    whole = changed_model(model, everything(system))
    base = extended(find_base_parameters(model), whole, ["payload.mass"])
    # I_zz + m x², m x and m y of the link, and the payload's mass.
    beta, std = np.array([0.6, 1.0, 0.0, -0.4]), np.full(4, 1e-3)
    assert names(base)[-1] == "payload.mass"
    assert PhysicalSet(whole, base).project(beta, np.diag(std**2)).distance > 10.0
    assert PhysicalSet(whole, base, ["payload"]).project(beta, np.diag(std**2)).distance == 0.0
