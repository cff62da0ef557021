"""Mistakes of one encoder alone that would set it apart from the joint's other one are not tried."""

from __future__ import annotations

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.diagnosis.agreeing_encoders import AgreeingEncoders
from sms_online.diagnosis.record import Segment
from sms_online.diagnosis.sample_mistakes import mistake_hypotheses

SYSTEM = load_system("paper-planar")
CHANNELS = ("tau_1", "q_1", "theta_m_1", "q_2", "theta_m_2")
TIME = np.arange(0.0, 4.0, 0.01)
MOVED = np.column_stack([np.sin(2.0 * TIME), np.sin(3.0 * TIME)])


def kept(deflection: float, **scales: float) -> set[str]:
    """Hypotheses of the two joints' encoders that are tried, name@where; scales: of channels."""
    rng = np.random.default_rng(0)
    columns = {"tau_1": rng.standard_normal(TIME.size)}
    for i in range(2):
        columns[f"q_{i + 1}"] = 0.5 + MOVED[:, i]
        columns[f"theta_m_{i + 1}"] = MOVED[:, i] + deflection * np.cos(7.0 * TIME)
    values = np.column_stack([scales.get(name, 1.0) * columns[name] for name in CHANNELS])
    pairs = AgreeingEncoders(CHANNELS, [Segment(np.arange(TIME.size), values)])
    return {f"{h.name}@{h.where}" for h in mistake_hypotheses(SYSTEM, CHANNELS) if not pairs.separated(h)}


def test_one_of_two_that_agree_is_not_wrong_alone() -> None:
    tried = kept(0.01)
    alone = {"angle_sign@q_1", "degrees@q_1", "counts@theta_m_1", "motor_angle@theta_m_1", "swapped@q_1, q_2"}
    assert not tried & alone
    assert {"angle_sign@q_1, theta_m_1", "degrees@all angles", "counts@q_1, theta_m_1"} <= tried


@pytest.mark.parametrize(
    ("scales", "wrong"),
    [
        ({"q_1": -1.0}, "angle_sign@q_1"),
        ({"theta_m_2": 57.3}, "degrees@theta_m_2"),
        ({"theta_m_1": 100.0}, "motor_angle@theta_m_1"),
        ({"q_2": 0.5}, "counts@q_2"),
    ],
)
def test_what_sets_them_apart_is_tried(scales: dict[str, float], wrong: str) -> None:
    assert wrong in kept(0.01, **scales)


def test_a_soft_spring_says_nothing() -> None:
    assert {"angle_sign@q_1", "counts@theta_m_1"} <= kept(0.5)
