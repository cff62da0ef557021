"""Planar is a choice of active coordinates: the same bodies described in space give the same numbers in the plane."""

from __future__ import annotations

import numpy as np
import pytest

from sms_online.effects.build import build_model
from sms_online.model.model import Model
from sms_online.stream import Array
from tests.model_systems import paper, random_states

RELATIVE = 1e-12
CASES = [(kinematics, free) for kinematics in ("linear", "exact") for free in (True, False)]
both = pytest.mark.parametrize(("kinematics", "free"), CASES)


def twins(kinematics: str, free: bool) -> tuple[Model, Model, list[int]]:
    """A planar model, its spatial twin, and the twin's indices of the planar speeds. Gravity lies in the plane."""
    gravity = {"gravity": (1.3, -2.0, 0.0)}
    planar = build_model(paper(kinematics, "planar", free).model_copy(update=gravity))
    spatial = build_model(paper(kinematics, "spatial", free).model_copy(update=gravity))
    return planar, spatial, [spatial.layout.speed_names.index(name) for name in planar.layout.speed_names]


def lift(planar: Model, spatial: Model, active: list[int], x: Array, v: Array) -> tuple[Array, Array]:
    """A planar state as a state in space."""
    X, V = np.zeros((len(x), spatial.layout.n_x)), np.zeros((len(v), spatial.layout.n_v))
    V[:, active] = v
    n = planar.layout.n_base_positions
    if n:
        X[:, :2] = x[:, :2]
        X[:, 5], X[:, 6] = np.sin(0.5 * x[:, 2]), np.cos(0.5 * x[:, 2])
    X[:, spatial.layout.n_base_positions :] = x[:, n:]
    return X, V


def close(found: Array, expected: Array) -> None:
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=RELATIVE * np.abs(expected).max())


@both
def test_energy_power_and_inertia_agree(kinematics: str, free: bool) -> None:
    planar, spatial, active = twins(kinematics, free)
    x, v = random_states(planar.layout, 8, seed=40)
    X, V = lift(planar, spatial, active, x, v)
    close(spatial.energy_columns(X, V) @ spatial.nominal, planar.energy_columns(x, v) @ planar.nominal)
    close(spatial.power_columns(X, V) @ spatial.nominal, planar.power_columns(x, v) @ planar.nominal)
    H = spatial.dynamics(spatial.nominal).mass_matrix(X)
    close(H[:, active][:, :, active], planar.dynamics(planar.nominal).mass_matrix(x))


@both
def test_forces_agree_and_none_leaves_the_plane(kinematics: str, free: bool) -> None:
    """C and the momentum rows agree; staying in the plane needs no force along z and no moment about x or y."""
    planar, spatial, active = twins(kinematics, free)
    x, v = random_states(planar.layout, 8, seed=41)
    X, V = lift(planar, spatial, active, x, v)
    _, C = planar.dynamics(planar.nominal).mass_and_bias(x, v)
    H_twin, C_twin = spatial.dynamics(spatial.nominal).mass_and_bias(X, V)
    close(C_twin[:, active], C)
    for ours, twin in zip(planar.momentum_columns(x, v), spatial.momentum_columns(X, V), strict=True):
        close(twin[:, active] @ spatial.nominal, ours @ planar.nominal)
    across = [k for k in range(spatial.layout.n_v) if k not in active]
    assert len(across) == (3 if free else 0)
    np.testing.assert_allclose(C_twin[:, across], 0.0, atol=RELATIVE * np.abs(C).max())
    np.testing.assert_allclose(H_twin[:, across][:, :, active], 0.0, atol=RELATIVE * np.abs(H_twin).max())


@both
def test_columns_agree_parameter_by_parameter(kinematics: str, free: bool) -> None:
    """What the plane names without an axis is the spatial parameter about or across z."""
    planar, spatial, active = twins(kinematics, free)
    x, v = random_states(planar.layout, 8, seed=42)
    X, V = lift(planar, spatial, active, x, v)
    about_z = {
        "spacecraft.inertia_about_joint_1": "spacecraft.inertia_about_joint_1_zz",
        "motor_1.stator_inertia": "motor_1.stator_inertia_zz",
        "motor_2.stator_inertia": "motor_2.stator_inertia_zz",
        "link_1.flexural_rigidity": "link_1.flexural_rigidity_z",
        "link_2.flexural_rigidity": "link_2.flexural_rigidity_z",
    }
    names = [p.name for p in spatial.parameters]
    columns = [names.index(about_z.get(p.name, p.name)) for p in planar.parameters]
    close(spatial.energy_columns(X, V)[:, columns], planar.energy_columns(x, v))
    for ours, twin in zip(planar.momentum_columns(x, v), spatial.momentum_columns(X, V), strict=True):
        close(twin[:, active][..., columns], ours)
