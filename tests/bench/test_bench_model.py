"""What the model's columns cost per sample, alone and beside Pinocchio's regressors on a rigid arm.

Run on demand: pytest tests/bench/test_bench_model.py --override-ini addopts=
Each benchmark notes microseconds per sample in its `extra_info`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sms_online.description.parse import parse_system, shipped_text
from sms_online.effects.build import build_model
from tests.model_systems import random_states, rigid_chain
from tests.test_model_rigid import Yardstick

pin: Any = pytest.importorskip("pinocchio", reason="Pinocchio (pip package `pin`) is the yardstick of the rigid case")

BLOCKS = (1, 128, 1000)


def measure(benchmark: Any, samples: int, call: Callable[[], object]) -> None:
    """Time a call that handles `samples` samples."""
    benchmark(call)
    benchmark.extra_info["microseconds_per_sample"] = round(1e6 * benchmark.stats.stats.median / samples, 3)


@pytest.mark.parametrize("B", BLOCKS)
@pytest.mark.parametrize("columns", ["energy_columns", "momentum_columns", "motor_rows"])
@pytest.mark.benchmark(group="paper-planar")
def test_columns_of_the_example(benchmark: Any, columns: str, B: int) -> None:
    """Energy columns, all momentum rows, and the rows of the motors alone."""
    model = build_model(parse_system(shipped_text("paper-planar"), "paper-planar"))
    x, v = random_states(model.layout, B, seed=1)
    calls: dict[str, Callable[[], object]] = {
        "energy_columns": lambda: model.energy_columns(x, v),
        "momentum_columns": lambda: model.momentum_columns(x, v),
        "motor_rows": lambda: model.momentum_columns(x, v, model.layout.theta_m),
    }
    measure(benchmark, B, calls[columns])


@pytest.mark.parametrize("B", BLOCKS)
@pytest.mark.parametrize("columns", ["energy_columns", "momentum_columns"])
@pytest.mark.benchmark(group="rigid free-floater, 7 joints")
def test_columns_of_a_rigid_arm(benchmark: Any, columns: str, B: int) -> None:
    model = build_model(rigid_chain(7, free=True))
    x, v = random_states(model.layout, B, seed=1)
    measure(benchmark, B, lambda: getattr(model, columns)(x, v))


@pytest.mark.parametrize("regressor", ["kinetic_energy", "joint_torque"])
@pytest.mark.benchmark(group="rigid free-floater, 7 joints")
def test_pinocchio_on_the_same_arm(benchmark: Any, regressor: str) -> None:
    """One sample a call, as Pinocchio works; called from Python."""
    system = rigid_chain(7, free=True)
    layout, yardstick = build_model(system).layout, Yardstick(system)
    x, v = random_states(layout, 1, seed=1)
    q, v_pin = yardstick.positions(layout, x[0]), yardstick.speed_map(layout, x[0]) @ v[0]
    arm, data, a = yardstick.model, yardstick.data, np.ones(yardstick.model.nv)
    calls: dict[str, Callable[[], object]] = {
        "kinetic_energy": lambda: pin.computeKineticEnergyRegressor(arm, data, q, v_pin),
        "joint_torque": lambda: pin.computeJointTorqueRegressor(arm, data, q, v_pin, a),
    }
    measure(benchmark, 1, calls[regressor])
