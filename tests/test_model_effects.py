"""Effects on motor shafts: one generalized force gives momentum rows, dissipated power and the simulated force."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sms_online.description.schema import Effect
from sms_online.effects.build import build_model
from sms_online.errors import InputError
from sms_online.stream import Array
from tests.model_systems import paper, random_states

LAWS: dict[str, tuple[str, Callable[[Array, float], Array]]] = {
    "viscous_friction": ("damping", lambda rate, n: -rate),
    "coulomb_friction": ("torque", lambda rate, n: -np.sign(rate)),
    "torque_offset": ("torque", lambda rate, n: np.full_like(rate, -n)),
}


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("joint", [1, 2])
def test_an_effect_is_a_force_on_its_own_motor(name: str, joint: int) -> None:
    """Its law on θ_m of its joint, after the gear; no other row feels it."""
    coefficient, law = LAWS[name]
    effect = Effect(name=name, where=f"joint_{joint}", coefficients={coefficient: 0.4})
    with_effect, without = build_model(paper(effects=(effect,))), build_model(paper())
    layout = with_effect.layout
    x, v = random_states(layout, 20, seed=80)
    G = with_effect.momentum_columns(x, v)[1][..., -1]
    column = layout.theta_m[joint - 1]
    np.testing.assert_allclose(G[:, column], law(v[:, column], 50.0))
    assert not np.delete(G, column, axis=1).any()
    np.testing.assert_allclose(with_effect.power_columns(x, v)[:, -1], -G[:, column] * v[:, column])
    assert not with_effect.energy_columns(x, v)[:, -1].any()
    C = with_effect.dynamics(with_effect.nominal).mass_and_bias(x, v)[1]
    C_without = without.dynamics(without.nominal).mass_and_bias(x, v)[1]
    np.testing.assert_allclose(C - C_without, -0.4 * G, atol=1e-12 * np.abs(C).max())
    assert with_effect.parameters[-1].name == f"{name}@joint_{joint}.{coefficient}"


def test_friction_takes_power_out_in_either_direction() -> None:
    effects = [Effect(name=name, where="joint_1") for name in ("viscous_friction", "coulomb_friction")]
    model = build_model(paper(effects=effects))
    x, v = random_states(model.layout, 50, seed=81)
    assert (model.power_columns(x, v)[:, -2:] > 0.0).all()


def test_an_undeclared_coefficient_is_zero() -> None:
    model = build_model(paper(effects=(Effect(name="coulomb_friction", where="joint_2"),)))
    assert model.nominal[-1] == 0.0


@pytest.mark.parametrize(
    ("effect", "words"),
    [
        (Effect(name="coulomb_frcition", where="joint_1"), "did you mean 'coulomb_friction'"),
        (Effect(name="coulomb_friction", where="joint_3"), "one of joint_1, joint_2"),
        (Effect(name="coulomb_friction", where="joint_1", coefficients={"damping": 1.0}), "expected 'torque'"),
    ],
)
def test_a_wrong_effect_is_refused_with_what_was_expected(effect: Effect, words: str) -> None:
    with pytest.raises(InputError, match=words):
        build_model(paper(effects=(effect,)))
