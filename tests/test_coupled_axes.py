"""Shafts that turn with the sum of two axes, springs that carry weight, gears under load: a rigid arm of three axes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_online.description.schema import Effect
from sms_online.diagnosed import diagnose
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import candidates, check_effect
from sms_online.errors import InputError
from sms_online.model.effect import Inputs
from tests.model_systems import random_states
from tests.rigid_arm import recorded, rigid_arm, with_friction

PAIR = "joint_2+joint_3"
STATES = 8


def test_the_friction_of_a_shared_shaft_acts_on_both_axes() -> None:
    model = build_model(rigid_arm(Effect(name="coupled_friction", where=PAIR)))
    x, v = random_states(model.layout, STATES, seed=1)
    both = v[:, 1] + v[:, 2]
    own = model.effect_slices[0]
    force = model.momentum_columns(x, v)[1][..., own] @ [3.0, 0.5]
    expected = -3.0 * np.sign(both) - 0.5 * both
    assert_allclose(force[:, 1:], np.stack((expected, expected), axis=1), rtol=1e-9)
    assert not force[:, 0].any()
    assert_allclose(model.power_columns(x, v)[:, own] @ [3.0, 0.5], 3.0 * np.abs(both) + 0.5 * both**2, rtol=1e-9)


def test_the_inertia_of_a_shared_shaft_moves_with_the_sum() -> None:
    """½ J r² of energy, J r of momentum on both axes, and J in the mass matrix: once, in balance and dynamics."""
    model = build_model(rigid_arm(Effect(name="coupled_inertia", where=PAIR, coefficients={"inertia": 0.2})))
    x, v = random_states(model.layout, STATES, seed=2)
    both = v[:, 1] + v[:, 2]
    (own,) = (k for k, p in enumerate(model.parameters) if "coupled" in p.name)
    assert_allclose(model.energy_columns(x, v)[:, own], 0.5 * both**2, rtol=1e-12)
    P, G = model.momentum_columns(x, v)
    assert_allclose(P[..., own], np.stack((0.0 * both, both, both), axis=1), rtol=1e-12, atol=1e-15)
    assert not G[..., own].any()
    H, C = model.dynamics(model.nominal).mass_and_bias(x, v)
    plain = build_model(rigid_arm())
    H_plain, C_plain = plain.dynamics(plain.nominal).mass_and_bias(x, v)
    added = np.zeros((3, 3))
    added[1:, 1:] = 0.2
    assert_allclose(H - H_plain, np.broadcast_to(added, H.shape), rtol=0, atol=1e-12)
    assert_allclose(C, C_plain, rtol=1e-12)


def test_a_gravity_spring_carries_weight_of_its_axis_alone() -> None:
    declared = Effect(name="gravity_spring", where="joint_2", coefficients={"amplitude": 20.0, "phase": 0.3})
    model = build_model(rigid_arm(declared))
    x, v = random_states(model.layout, STATES, seed=3)
    own = model.effect_slices[0]
    force = model.momentum_columns(x, v)[1][..., own] @ model.nominal[own]
    expected = np.zeros_like(force)
    expected[:, 1] = -20.0 * np.cos(x[:, 1] - 0.3)
    assert_allclose(force, expected, rtol=1e-12)
    assert model.effects[0].reported(model.nominal[own]) == pytest.approx({"amplitude": 20.0, "phase": 0.3})


def test_friction_of_a_rigid_gear_goes_with_the_torque() -> None:
    declared = Effect(name="load_friction", where="joint_2", coefficients={"ratio": 0.04})
    model = build_model(rigid_arm(declared))
    x, v = random_states(model.layout, STATES, seed=4)
    torque = np.random.default_rng(5).normal(size=(STATES, 3))
    own = model.effect_slices[0]
    force = model.momentum_columns(x, v, inputs=Inputs(torque, np.zeros((STATES, 0))))[1][..., own] @ model.nominal[own]
    expected = np.zeros_like(force)
    expected[:, 1] = -0.04 * np.abs(torque[:, 1]) * np.sign(v[:, 1])
    assert_allclose(force, expected, rtol=1e-9, atol=1e-15)
    assert model.effects[0].reported(model.nominal[own]) == {"ratio": 0.04}


def test_only_axes_in_a_row_share_a_shaft() -> None:
    arm = rigid_arm()
    assert [e.where for e in candidates(arm) if e.name == "coupled_friction"] == ["joint_1+joint_2", PAIR]
    with pytest.raises(InputError, match=r"joint_1\+joint_2, joint_2\+joint_3"):
        check_effect(arm, Effect(name="coupled_friction", where="joint_1+joint_3"), "effect 1", "arm")
    weightless = arm.model_copy(update={"gravity": (0.0, 0.0, 0.0)})
    assert "gravity_spring" not in {effect.name for effect in candidates(weightless)}


@pytest.mark.long
def test_a_coupled_wrist_is_named() -> None:
    """Friction and inertia of a shaft that turns with both last axes, under torque noise of 1 % that is coloured."""
    coupled = (
        Effect(name="coupled_friction", where=PAIR, coefficients={"torque": 1.5, "damping": 1.0}),
        Effect(name="coupled_inertia", where=PAIR, coefficients={"inertia": 0.15}),
    )
    capture = recorded(with_friction(*coupled), 20.0, seed=5)
    found = diagnose(with_friction(), capture)
    assert "coupled_friction@joint_2+joint_3" in {f.candidate.key for f in found.search.findings}
    after = found.search.after.holdout.relative
    # Of the noise, 0.011 of the torque, a model with everything leaves as much.
    assert max(after["joint_2"], after["joint_3"]) < 0.015


@pytest.mark.long
def test_a_gear_that_loses_a_share_of_its_load_is_named() -> None:
    """A share of the load itself, from which the motor's torque of the law differs by friction: in second order."""
    found = diagnose(with_friction(), recorded(with_friction(), 20.0, seed=6, lost=np.array([0.0, 0.08, 0.0])))
    assert [f.candidate.key for f in found.search.findings] == ["load_friction@joint_2"]
    assert found.effects[0].coefficients["ratio"].value == pytest.approx(0.08, rel=0.1)
