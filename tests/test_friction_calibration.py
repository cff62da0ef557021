"""What a session says of its encoder where dry friction reverses: no more than the motion tells."""

from __future__ import annotations

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.parse import parse_system
from sms_online.stream import Block
from tests.axis import AXIS, DAMPING, INERTIA

RATE = 250.0

COULOMB = """
[[effect]]
name = "coulomb_friction"
where = "joint_1"
"""


@pytest.mark.parametrize("coulomb", [0.5, 5.0])
def test_no_row_shows_the_zero_of_an_axis_without_gravity(coulomb: float) -> None:
    """Nor does friction, which reverses with the rate; its size is found all the same."""
    # At 250 Hz samples of a window fall between the steps at which noise is followed through it.
    described = AXIS.replace("sample_rate = 200.0", f"sample_rate = {RATE}")
    session = sms.Session(parse_system(described + COULOMB, "axis"), ("force_1", "q_1"))
    t = np.arange(round(12.0 * RATE)) / RATE
    q = np.sin(2.0 * t) + 0.3 * np.sin(5.0 * t)
    rate, acceleration = 2.0 * np.cos(2.0 * t) + 1.5 * np.cos(5.0 * t), -4.0 * np.sin(2.0 * t) - 7.5 * np.sin(5.0 * t)
    torque = INERTIA * acceleration + DAMPING * rate + coulomb * np.sign(rate)
    noise = np.random.default_rng(3).standard_normal((t.size, 2)) * (0.01, 1e-6)
    session.update(Block(t, ("force_1", "q_1"), np.column_stack((torque, q)) + noise))
    session.finish()
    evaluation = session.evaluation()
    std = dict(
        zip(
            ((each.name, each.where, each.part) for each in evaluation.statistics.setup.nuisances),
            evaluation.estimate.nuisances_std.tolist(),
            strict=True,
        )
    )
    tolerances = session.system.tolerances
    assert std["encoder_zero", "q_1", ""] == pytest.approx(tolerances.encoder_zero, rel=1e-3)
    # A scale of the angle's is one of its acceleration's: the torque's noise hides a thousandth of that.
    assert std["once_per_turn", "q_1", "sine"] == pytest.approx(tolerances.once_per_turn, rel=0.1)
    # At samples friction changes its sign half a sample from where it does, on average.
    assert session.result.parameters["coulomb_friction@joint_1.torque"].value == pytest.approx(coulomb, rel=2e-3)
