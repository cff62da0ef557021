"""Every effect's law against a formula of its own; its power; where it may be declared."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_online.description.bodies import Inertia, RigidBody
from sms_online.description.schema import Effect
from sms_online.effects.base import STANDSTILL, Ranges, Site, report
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import ENTRIES, NAMES, candidates, parse_effect
from sms_online.errors import InputError
from tests.effect_laws import LAWS, LINK_2, M_1, STATES, Motion, with_effect
from tests.guide import windage
from tests.model_systems import paper, random_states, spatial


@pytest.mark.parametrize("text", LAWS)
def test_the_generalized_force_is_the_law(text: str) -> None:
    """In the rows it acts on and in no other; the power it takes out is -f · v; mass and energy know nothing of it."""
    model = with_effect(text)
    s = Motion(model)
    expected = np.zeros_like(s.v)
    for speed, force in LAWS[text](s).items():
        expected[:, speed] = force
    own = model.effect_slices[0]
    P, G = model.momentum_columns(s.x, s.v, inputs=s.inputs)
    # A sign is a tanh: at the slowest of these rates it is one to 1e-12.
    assert np.abs(s.rate).min() > 15.0 * STANDSTILL
    assert_allclose(G[..., own] @ model.nominal[own], expected, rtol=1e-9, atol=1e-12)
    assert not P[..., own].any()
    assert not model.energy_columns(s.x, s.v)[:, own].any()
    power = model.power_columns(s.x, s.v, s.inputs)[:, own] @ model.nominal[own]
    assert_allclose(power, -np.sum(expected * s.v, axis=1), rtol=1e-9, atol=1e-12)
    C = model.dynamics(model.nominal).mass_and_bias(s.x, s.v, s.inputs)[1]
    C_without = build_model(paper()).dynamics(build_model(paper()).nominal).mass_and_bias(s.x, s.v)[1]
    assert_allclose(C_without - C, expected, rtol=0, atol=1e-10 * np.abs(C).max())


def test_link_damping_resists_bending_as_its_stiffness_would() -> None:
    """A rate of bending q̇_f meets η times the force of a bend q_f = q̇_f."""
    model, clean = with_effect("link_damping@link_2:time=0.002"), build_model(paper())
    s = Motion(model)
    own = model.effect_slices[0]
    bent = s.x.copy()
    bent[:, LINK_2] = s.v[:, LINK_2]
    stiffness = [p.name for p in clean.parameters].index("link_2.flexural_rigidity")
    K_bent = clean.momentum_columns(bent, s.v)[1][..., stiffness] * 597.87
    K_bent[:, : LINK_2.start] = 0.0
    assert_allclose(model.momentum_columns(s.x, s.v)[1][..., own] @ model.nominal[own], 0.002 * K_bent, atol=1e-9)


@pytest.mark.parametrize("kinematics", ["linear", "exact"])
def test_mass_damping_dissipates_kinetic_energy_in_proportion(kinematics: str) -> None:
    """With its root held fast, c q̇_fᵀ M_f q̇_f = 2 c K."""
    model = with_effect("link_mass_damping@link_1:rate=0.7", paper(kinematics))
    x, v = random_states(model.layout, STATES, seed=3)
    fast = np.zeros_like(v)
    fast[:, model.layout.q_f[0]] = v[:, model.layout.q_f[0]]
    names = [p.name for p in model.parameters]
    mass = names.index("link_1.mass_per_length")
    energy = model.energy_columns(x, fast)[:, mass] * model.nominal[mass]
    own = model.effect_slices[0]
    power = model.power_columns(x, fast)[:, own] @ model.nominal[own]
    assert_allclose(power, 2 * 0.7 * energy, rtol=1e-12)


def test_a_tilted_table_is_gravity() -> None:
    """Of the same masses: columns of a system with gravity, for which the model has code of its own."""
    tilted = with_effect("table_tilt@base:gravity_x=0.2,gravity_y=-0.3")
    level, heavy = build_model(paper()), build_model(paper().model_copy(update={"gravity": (0.2, -0.3, 0.0)}))
    x, v = random_states(tilted.layout, STATES, seed=4)
    own = tilted.effect_slices[0]
    force = tilted.momentum_columns(x, v)[1][..., own] @ tilted.nominal[own]
    weight = (heavy.momentum_columns(x, v)[1] - level.momentum_columns(x, v)[1]) @ level.nominal
    assert_allclose(force, weight, rtol=0, atol=1e-11 * np.abs(weight).max())
    half = build_model(tilted.system, reference=0.5 * tilted.nominal)
    assert_allclose(half.momentum_columns(x, v)[1][..., own] @ tilted.nominal[own], 0.5 * force, atol=1e-9)


def test_a_point_mass_at_the_tip_is_a_payload_of_no_size() -> None:
    system = paper()
    body = RigidBody(mass=2.0, inertia=Inertia(zz=0.3))
    described = build_model(system.model_copy(update={"payload": body}))
    declared = with_effect("tip_payload@tip:mass=2,inertia=0.3", system)
    x, v = random_states(declared.layout, STATES, seed=5)
    for ours, theirs in zip(declared.momentum_columns(x, v), described.momentum_columns(x, v), strict=True):
        assert_allclose(ours @ declared.nominal, theirs @ described.nominal, rtol=0, atol=1e-9)
    assert_allclose(
        declared.energy_columns(x, v) @ declared.nominal, described.energy_columns(x, v) @ described.nominal
    )


def test_an_effect_that_lacks_its_inputs_says_so() -> None:
    for text in ("torque_gain@joint_2:ratio=0.1", "torsional_hysteresis@joint_1:torque=1"):
        model = with_effect(text)
        s = Motion(model)
        with pytest.raises(ValueError, match=text.split(":")[0]):
            model.momentum_columns(s.x, s.v)


def test_hysteresis_saturates_and_reverses_with_its_slope() -> None:
    model = with_effect("torsional_hysteresis@joint_1:torque=2,width=0.02")
    x, v = np.zeros((1, model.layout.n_x)), np.zeros((1, model.layout.n_v))
    v[0, M_1] = 0.3
    saturated = np.array([[0.02]])
    assert model.state_rate(x, v, saturated)[0, 0] == pytest.approx(0.0, abs=1e-15)
    assert model.state_rate(x, -v, saturated)[0, 0] == pytest.approx(-0.6)
    assert model.state_rate(x, v, np.zeros((1, 1)))[0, 0] == pytest.approx(0.3)


def test_a_gap_is_found_by_what_it_takes_off_beyond() -> None:
    """A spring that loses 4 % too much in a gap 4 % too narrow is that of the gap, unless what it loses is stated."""
    (own,) = with_effect("backlash@joint_1:gap=0.0096").effects
    assert own.relative_to == ("joint_1.stiffness",)
    assert own.reported(np.array([1040.0, 998.4]))["gap"] == pytest.approx(0.01)
    (stated,) = with_effect("backlash@joint_1:gap=0.01,stiffness=500").effects
    assert stated.reported(np.array([520.0])) == {"gap": 0.01}


def test_slosh_swings_about_the_base_at_its_frequency() -> None:
    model = with_effect("slosh@base:mass=2,stiffness=50")
    s = Motion(model)
    assert_allclose(model.state_rate(s.x, s.v, s.z)[:, :2], s.z[:, 2:])
    assert_allclose(model.state_rate(s.x, s.v, s.z)[:, 2:], -25.0 * (s.z[:, :2] - s.x[:, :2]))
    assert_allclose(model.initial_state(s.x[0]), [*s.x[0, :2], 0.0, 0.0])


# Reported coefficients


REPORTED = (
    *LAWS,
    "link_damping@link_2:time=0.002",
    "link_mass_damping@link_1:rate=0.7",
    "table_tilt@base:gravity_x=0.2,gravity_y=-0.3",
)


@pytest.mark.parametrize("text", REPORTED)
def test_what_is_declared_is_what_is_reported(text: str) -> None:
    model = with_effect(text)
    names = [p.name for p in model.parameters]
    reported = report(model.effects[0], names, model.nominal, np.zeros((model.n_pi, model.n_pi)))
    for coefficient, value in model.system.effects[0].coefficients.items():
        assert reported[coefficient][0] == pytest.approx(value, rel=1e-12), coefficient


def test_an_amplitude_s_deviation_is_that_of_its_parts_along_it() -> None:
    """Parts 3 and 4 with deviations 0.1 and 0.2: a = 5 ± √(0.06² + 0.16²), φ ± √((4·0.1)² + (3·0.2)²) / 25."""
    model = with_effect("cogging@joint_1:amplitude=5,phase=0.9272952180016122,order=2")
    covariance = np.diag([0.01, 0.04])
    names = [p.name for p in model.effects[0].parameters]
    reported = report(model.effects[0], names, np.array([3.0, 4.0]), covariance)
    assert reported["amplitude"] == (pytest.approx(5.0), pytest.approx(np.hypot(0.06, 0.16), rel=1e-6))
    assert reported["phase"] == (pytest.approx(0.9272952180016122), pytest.approx(np.hypot(0.4, 0.6) / 25.0, rel=1e-6))
    assert reported["order"] == (2.0, 0.0)


def test_a_ratio_needs_what_it_is_relative_to() -> None:
    model = with_effect("load_friction@joint_1:ratio=0.1")
    with pytest.raises(ValueError, match=r"joint_1\.stiffness"):
        report(model.effects[0], [model.effects[0].parameters[0].name], np.ones(1), np.eye(1))


# The catalogue


def test_candidates_of_a_system_can_be_declared_together() -> None:
    for system in (paper(), spatial("linear").model_copy(update={"effects": ()})):
        effects = candidates(system)
        model = build_model(system.model_copy(update={"effects": tuple(effects)}))
        assert {effect.name for effect in effects} <= set(NAMES)
        assert {e.name for e in effects if ENTRIES[e.name].kind == "force"} == {e.name for e in model.effects}
        assert len({(effect.name, effect.where) for effect in effects}) == len(effects)
        assert len({p.name for p in model.parameters}) == model.n_pi


def test_candidates_of_the_planar_example_are_complete() -> None:
    # Axes in a plane share no shaft, and without gravity no spring carries weight.
    others = {"coupled_friction", "coupled_inertia", "gravity_spring"}
    assert {effect.name for effect in candidates(paper())} == set(NAMES) - others
    declared = paper(effects=(Effect(name="air_drag", where="base"),))
    assert "air_drag" not in {effect.name for effect in candidates(declared)}


def test_a_gain_is_relative_to_the_first_joint() -> None:
    places = [effect.where for effect in candidates(paper()) if effect.name == "torque_gain"]
    assert places == ["joint_2"]


def test_grids_lie_within_the_motion_s_ranges() -> None:
    ranges = Ranges(speed=2.0, swing=1.0, deflection=0.05, duration=20.0, sample_rate=1000.0)
    for entry in ENTRIES.values():
        assert entry.separated_by
        for name, shape in entry.shapes.items():
            grid = shape.grid(ranges)
            assert len(set(grid)) == len(grid) > 0
            if name in ("gap", "width"):
                assert 0.0 < min(grid) < max(grid) < ranges.deflection
            if name == "velocity":
                assert 0.0 < min(grid) < max(grid) < ranges.speed


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("coulomb_frcition@joint_1", "did you mean 'coulomb_friction'"),
        ("coulomb_friction", "expected NAME@WHERE"),
        ("coulomb_friction@joint_3", "one of joint_1, joint_2"),
        ("torque_gain@joint_1", "expected one of joint_2"),
        ("coulomb_friction@joint_1:damping=1", "expected 'torque'"),
        ("coulomb_friction@joint_1:torque=much", "'torque=much'; expected coefficient=value with a finite number"),
        ("coulomb_friction@joint_1:torque=inf", "a finite number"),
        ("coulomb_friction@joint_1:torque", "a finite number"),
        ("coulomb_friction@joint_1:torque=1,torque=2", "'torque' twice"),
        ("backlash@joint_1:gap=0", "a number greater than 0"),
        ("thruster_leak@base:force_z=1", "expected 'force_x' or 'force_y'"),
        ("sensor_lag@tau_1:corner=10", "sensor_lag at 'tau_1'"),
        ("encoder_offset@nothing_*", "encoder_offset at 'nothing_*'"),
    ],
)
def test_a_wrong_effect_is_refused_in_one_line(text: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_effect(text, paper())
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_exact_link_has_no_effect_of_geometric_stiffening() -> None:
    assert (
        build_model(paper(effects=(Effect(name="geometric_stiffening", where="link_1"),))).system.links[0].kinematics
        == "exact"
    )
    with pytest.raises(InputError, match="linear link"):
        parse_effect("geometric_stiffening@link_1", paper("exact"))


def test_the_guide_lists_every_effect_with_its_defaults() -> None:
    guide = (Path(__file__).parent.parent / "docs" / "reference" / "effects.md").read_text(encoding="utf-8")
    rows = {line.split("`")[1]: line for line in guide.splitlines() if line.startswith("| `")}
    assert set(rows) == set(NAMES)
    for name, entry in ENTRIES.items():
        for coefficient in (*entry.coefficients, *entry.further, *entry.shapes):
            assert f"`{coefficient}`" in rows[name], (name, coefficient)
        for shape in entry.shapes.values():
            assert f"{shape.default:.3g} {shape.unit}".strip() in rows[name], name


def test_an_effect_as_the_guide_writes_it_is_one() -> None:
    model = build_model(paper())
    declared = Effect(name="windage_friction", where="joint_1")
    site = Site(model.system, model.chain, declared, 1, model.weight)
    effect = windage()(site, {"drag": 0.3})  # type: ignore[call-arg, arg-type]
    s = Motion(model)
    f = effect.force(model.layout, s.x, s.v, None)[..., 0] * effect.parameters[0].nominal
    assert_allclose(f[:, M_1], np.where(s.rate > 0.0, -0.3, 0.3) * s.rate**2)
    assert not np.delete(f, M_1, axis=1).any()
    assert effect.parameters[0].name == "windage_friction@joint_1.drag"
