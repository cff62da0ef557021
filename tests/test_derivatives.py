"""Derivatives along a motion are those of central differences, by speeds too, at which nothing is evaluated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.calibration.geometry import geometries
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.model.model import Model
from sms_online.pipeline.derivatives import Derivatives
from sms_online.stream import Array
from tests.model_systems import paper, random_states, spatial

STEP = 1e-6
SYSTEMS: dict[str, Callable[[], System]] = {
    "planar": paper,
    "planar, exact links": lambda: paper("exact"),
    "spatial": lambda: load_system("spatial-two-link"),
    "spatial, prismatic joint, gravity, effects": lambda: spatial(free=False),
}


def states(model: Model, count: int) -> tuple[Array, Array, Array]:
    """Random positions and speeds, and signals of zero."""
    x, v = random_states(model.layout, count, seed=3)
    return x, v, np.zeros((count, len(model.layout.q) + model.n_states))


@pytest.mark.parametrize("name", SYSTEMS)
def test_derivatives_are_those_of_central_differences(name: str) -> None:
    model = build_model(SYSTEMS[name]())
    x, v, signals = states(model, 3)
    dynamics, n_v = model.dynamics(model.nominal), model.layout.n_v
    chosen = np.array([True, False, True])
    computed, _ = Derivatives(model).at(model.nominal, x, v, signals, dynamics.mass_matrix(x), chosen)
    inputs = model.inputs(signals)
    expected = np.zeros((len(x), n_v, 3 * n_v))
    for k, unit in enumerate(np.eye(n_v)):
        step = np.tile(STEP * unit, (len(x), 1))
        by_x = [dynamics.momentum_and_force(x + model.position_rate(x, sign * step), v, inputs) for sign in (1, -1)]
        by_v = [dynamics.momentum_and_force(x, v + sign * step, inputs)[1] for sign in (1, -1)]
        expected[:, :, k] = (by_x[0][0] - by_x[1][0]) / (2.0 * STEP)
        expected[:, :, n_v + k] = (by_v[0] - by_v[1]) / (2.0 * STEP)
        expected[:, :, 2 * n_v + k] = (by_x[0][1] - by_x[1][1]) / (2.0 * STEP)
    for part in np.split(np.arange(3 * n_v), 3):
        size = np.abs(expected[..., part]).max()
        np.testing.assert_allclose(computed[..., part], expected[chosen][..., part], rtol=0.0, atol=1e-6 * size)


def test_a_long_motion_in_pieces_has_the_same_derivatives(monkeypatch: pytest.MonkeyPatch) -> None:
    system = load_system("spatial-two-link")
    model = build_model(system)
    x, v, signals = states(model, 5)
    moved = Derivatives(model, list(geometries(system)))
    H, chosen = model.dynamics(model.nominal).mass_matrix(x), np.array([True, False, True, False, True])
    at_once = moved.at(model.nominal, x, v, signals, H, chosen)
    monkeypatch.setattr("sms_online.pipeline.derivatives.TOGETHER", 2 * (model.layout.n_v + 10))
    for whole, pieces in zip(at_once, moved.at(model.nominal, x, v, signals, H, chosen), strict=True):
        np.testing.assert_allclose(pieces, whole, rtol=0.0, atol=1e-7 * np.abs(whole).max())
