"""Base parameters: what the motion of a system can determine, found numerically and printed readably."""

from __future__ import annotations

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.bodies import Joint, Motor, RigidLink
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import BaseParameters, find_base_parameters
from sms_online.model.model import Model
from sms_online.stream import Array
from tests.model_systems import SYSTEMS, paper, random_states, rigid_chain, spatial

RELATIVE = 1e-9

TABLE_V = {
    "spacecraft.inertia_about_joint_1": 865.0075,
    "spacecraft.first_moment_x": 400.0,
    "spacecraft.first_moment_y": 400.0,
    "spacecraft.mass_with_motor_1": 403.0,
    "motor_1.rotor_inertia": 0.0075,
    "motor_2.rotor_inertia": 0.0075,
    "motor_2.stator_inertia": 0.0075,
    "motor_2.mass": 3.0,
    "link_1.mass_per_length": 31.42,
    "link_2.mass_per_length": 31.42,
    "link_1.flexural_rigidity": 1768.8,
    "link_2.flexural_rigidity": 597.87,
    "joint_1.stiffness": 1000.0,
    "joint_2.stiffness": 1000.0,
    "joint_1.damping": 75.85,
    "joint_2.damping": 75.85,
}

CASES: dict[str, System] = {
    **SYSTEMS,
    "rigid, 7 joints": rigid_chain(7, free=True),
    "rigid, driven, fixed": rigid_chain(4, free=False, prismatic=2, motors=True),
    "some known": paper().model_copy(update={"known": {"motor_1.mass": 3.0, "motor_2.mass": 3.0}}),
    "weightless": spatial("linear").model_copy(update={"gravity": (0.0, 0.0, 0.0)}),
}


@pytest.fixture(scope="module", params=CASES)
def case(request: pytest.FixtureRequest) -> tuple[Model, BaseParameters]:
    model = build_model(CASES[request.param])
    return model, find_base_parameters(model)


def close(found: Array, expected: Array, tolerance: float = RELATIVE) -> None:
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("kinematics", ["linear", "exact"])
def test_the_example_has_the_sixteen_of_table_v(kinematics: str) -> None:
    base = find_base_parameters(build_model(paper(kinematics)))
    assert [p.name for p in base.parameters] == list(TABLE_V)
    np.testing.assert_allclose([p.nominal for p in base.parameters], list(TABLE_V.values()), rtol=1e-12)


def test_combinations_are_printed_as_the_paper_prints_them() -> None:
    base = find_base_parameters(build_model(paper()))
    symbols = {p.name: p.symbol for p in base.parameters}
    assert symbols["spacecraft.inertia_about_joint_1"] == "I_0+m_0 r_0²+I_s1"
    assert symbols["spacecraft.mass_with_motor_1"] == "m_0+m_m1"
    units = {p.name: p.unit for p in base.parameters}
    assert units["joint_1.damping"] == "N m s/rad"
    assert units["link_1.flexural_rigidity"] == "N m²"


def test_the_same_arm_on_a_fixed_base() -> None:
    """What the base carries moves no more: stator 1 and the mass of motor 1 are gone, all else stays."""
    base = find_base_parameters(build_model(paper(free=False)))
    expected = [name for name in TABLE_V if not name.startswith("spacecraft")]
    assert [p.name for p in base.parameters] == expected
    gone = {base.physical[k].name for k in base.absent}
    assert gone == {"motor_1.stator_inertia", "motor_1.mass"}


def test_number_of_base_parameters_of_a_rigid_arm() -> None:
    """A free-floater with skew revolute joints: ten of the base and seven a link.

    Source: Mayeda, Yoshida, Osuka, IEEE Trans. Robotics and Automation 6 (1990) 312.
    """
    for joints in (3, 5):
        system = rigid_chain(joints, free=True).model_copy(update={"payload": None})
        assert find_base_parameters(build_model(system)).n == 10 + 7 * joints


def test_known_parameters_leave_the_unknowns() -> None:
    """With the mass of motor 1 known the spacecraft's mass is separable, and the known masses enter as numbers."""
    model = build_model(CASES["some known"])
    base = find_base_parameters(model)
    names = [p.name for p in base.parameters]
    assert "spacecraft.mass" in names
    assert "motor_2.mass" not in names
    assert base.n == 15
    x, v = random_states(model.layout, 3, seed=60)
    Y = model.energy_columns(x, v)
    index = {p.name: k for k, p in enumerate(model.parameters)}
    close(base.known_part(Y), 3.0 * (Y[:, index["motor_1.mass"]] + Y[:, index["motor_2.mass"]]))


def test_energy_balance_is_the_same_in_base_parameters(case: tuple[Model, BaseParameters]) -> None:
    """Y π = Y_base β + the known part, for any values of π, in differences of energy and in dissipated power."""
    model, base = case
    x, v = random_states(model.layout, 40, seed=61)
    pi = np.random.default_rng(62).normal(size=model.n_pi)
    for index, value in base.known:
        pi[index] = value
    energy = model.energy_columns(x, v)
    for Y in (energy[1:] - energy[0], model.power_columns(x, v)):
        close(base.columns(Y) @ base.values(pi) + base.known_part(Y), Y @ pi)


def test_combinations_of_nominal_parameters_are_nominal(case: tuple[Model, BaseParameters]) -> None:
    model, base = case
    np.testing.assert_allclose([p.nominal for p in base.parameters], base.values(model.nominal), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(
        base.values(base.physical_values(base.values(model.nominal))), base.values(model.nominal)
    )


def test_base_parameters_reconstruct_the_full_dynamics(case: tuple[Model, BaseParameters]) -> None:
    """H and C, row by row, from β alone."""
    model, base = case
    x, v = random_states(model.layout, 5, seed=63)
    H, C = model.dynamics(model.nominal).mass_and_bias(x, v)
    H_base, C_base = model.dynamics(base.physical_values(base.values(model.nominal))).mass_and_bias(x, v)
    close(H_base, H)
    close(C_base, C)


def test_columns_of_base_parameters_are_independent(case: tuple[Model, BaseParameters]) -> None:
    """On states of another seed than the search's own, scaled columns leave no combination near zero."""
    model, base = case
    x, v = random_states(model.layout, 5 * base.n, seed=64)
    energy = model.energy_columns(x, v)
    Y = base.columns(np.concatenate((energy[1:] - energy[0], model.power_columns(x, v))))
    singular = np.linalg.svd(Y / np.linalg.norm(Y, axis=0), compute_uv=False)
    assert singular[-1] > 1e-7 * singular[0]
    assert sorted(base.independent + base.dependent + base.absent) == list(range(model.n_pi))


def test_finding_them_is_deterministic() -> None:
    first, second = (find_base_parameters(build_model(SYSTEMS["spatial exact"])) for _ in range(2))
    assert first.parameters == second.parameters
    assert (first.mixture == second.mixture).all()


# Mounts, rad in units of π/2 about x, and tips, m, of two six-axis arms: one with a spherical wrist, one with three
# parallel axes and an offset wrist.
RIGHT_ANGLES = {
    "spherical wrist": ((2, 1, 0, -1, 1, -1), ((0.35, 0, -0.675), (1.15, 0, 0), (0.04, 0, 0.2), (0, 0, -1.2))),
    "three parallel axes": ((0, 1, 0, 0, 1, -1), ((0, 0, 0.18), (-0.61, 0, 0), (-0.57, 0, 0.17), (0, -0.12, 0))),
}


def right_angled(name: str) -> System:
    """A rigid arm on a fixed base whose mounts are turned by right angles about x; motors on all axes."""
    turns, tips = RIGHT_ANGLES[name]
    chain = rigid_chain(6, free=False, motors=True)
    return chain.model_copy(
        update={
            "gravity": (0.0, 0.0, -9.81),
            "payload": None,
            "motors": tuple(Motor(mass=1.5, rotor_inertia=0.002) for _ in turns),
            "joints": tuple(
                Joint(mount_rotation=(turn * np.pi / 2, 0.0, 0.0), gear_ratio=100.0, transmission="rigid")
                for turn in turns
            ),
            "links": tuple(
                RigidLink(**{**link.model_dump(), "tip": tip})
                for link, tip in zip(chain.links, (*tips, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), strict=True)
            ),
        }
    )


@pytest.mark.parametrize("decimals", [4, 6, 9, 11])
@pytest.mark.parametrize("arm", ["seven-joint", "spatial-two-link", *RIGHT_ANGLES])
def test_mounts_rounded_to_decimals_change_no_base_parameter(arm: str, decimals: int) -> None:
    """Axes that are parallel or cross in the drawing do so in the model, however many digits somebody wrote down."""
    system = right_angled(arm) if arm in RIGHT_ANGLES else load_system(arm)
    mounts = (tuple(round(angle, decimals) for angle in joint.mount_rotation) for joint in system.joints)
    joints = tuple(
        joint.model_copy(update={"mount_rotation": mount}) for joint, mount in zip(system.joints, mounts, strict=True)
    )
    exact, rounded = (
        find_base_parameters(build_model(s)) for s in (system, system.model_copy(update={"joints": joints}))
    )
    assert [p.name for p in rounded.parameters] == [p.name for p in exact.parameters]
    nominal = [p.nominal for p in exact.parameters]
    # An angle that is off by half of its last decimal moves a combination by that share of what is lumped into it.
    slack = 20.0 * 10.0**-decimals * max(np.abs(nominal))
    np.testing.assert_allclose([p.nominal for p in rounded.parameters], nominal, rtol=0.0, atol=slack)
