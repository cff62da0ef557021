"""Zeros of torques that differ between captures of one rig, beside friction that nobody described."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student_t

import sms_online as sms
from sms_online.description.parse import parse_system
from sms_online.diagnosis.torque_zeros import LEAST_STRETCHES, LEAST_WINDOWS, _Offsets
from tests.test_compare import ELASTIC_AXIS, STIFFNESS

FRICTION = ["coulomb_friction@joint_1:torque=0.5"]
# Of the rms of the torque.
SECOND, HELD_OUT = 0.3, -0.2


@pytest.fixture(scope="module")
def system() -> sms.System:
    return parse_system(ELASTIC_AXIS.format(stiffness=STIFFNESS), "rig.toml")


@pytest.fixture(scope="module")
def captures(system: sms.System) -> list[sms.Capture]:
    return [sms.simulate(system, grade="B", seed=seed, effects=FRICTION) for seed in range(3)]


def shifted(capture: sms.Capture, share: float) -> tuple[sms.Capture, float]:
    """A capture whose torque reads too much by a share of its rms, and that torque."""
    torque = capture.channels.index("tau_1")
    offset = share * float(np.sqrt(np.mean(capture.values[:, torque] ** 2)))
    values = capture.values.copy()
    values[:, torque] += offset
    return replace(capture, values=values), offset


@pytest.mark.long
def test_zeros_that_differ_are_taken_off(system: sms.System, captures: list[sms.Capture]) -> None:
    second, offset = shifted(captures[1], SECOND)
    third, offset_held_out = shifted(captures[2], HELD_OUT)
    found = sms.diagnose(system, [captures[0], second], holdout=third)
    assert [(each.name, each.where) for each in found.effects] == [("coulomb_friction", "joint_1")]
    assert found.verdict == "named"
    zeros = found.document()["torque_zeros"]
    assert [zero["capture"] for zero in zeros] == [2, None]
    for zero, true in zip(zeros, (offset, offset_held_out), strict=True):
        assert zero["channel"] == "tau_1"
        assert abs(zero["offset"] - true) < 3.0 * zero["std"]
        assert zero["std"] < 0.1 * abs(true)
    assert len([warning for warning in found.warnings if "tau_1 reads" in warning]) == len(zeros)


@pytest.mark.slow
def test_equal_zeros_are_left_alone(system: sms.System, captures: list[sms.Capture]) -> None:
    found = sms.diagnose(system, captures[:2], holdout=captures[2])
    assert found.document()["torque_zeros"] == []
    assert [each.name for each in found.effects] == ["coulomb_friction"]


class Rows:
    """Rows of one joint: three columns that vary slowly, and an error that is correlated over some windows."""

    def __init__(self, windows: int, random: np.random.Generator) -> None:
        self.columns = correlated(random, 0.9, (windows, 1, 3))
        self.error = correlated(random, 0.5, (windows, 1))
        self.measured = 10.0 * random.standard_normal((windows, 1))

    def left(self, described: np.ndarray) -> np.ndarray:
        return self.columns @ np.ones(3) - self.columns @ described + self.error


def correlated(random: np.random.Generator, share: float, shape: tuple[int, ...]) -> np.ndarray:
    out = random.standard_normal(shape)
    for k in range(1, len(out)):
        out[k] += share * out[k - 1]
    return out


@pytest.mark.parametrize("windows", [(200, 200), (100,) * 5, (380, 60), (200, 20)])
def test_deviations_hold_whatever_the_lengths_of_captures(windows: tuple[int, ...]) -> None:
    """Offsets without a difference are Student's t over their deviations; too short captures have none."""
    random, z = np.random.default_rng(1), []
    for _ in range(60):
        rows = Rows(sum(windows), random)
        offsets = _Offsets(rows, None, np.zeros(3), np.repeat(np.arange(len(windows)), windows))  # type: ignore[arg-type]
        for capture in offsets.comparable:
            offset, std, _ = offsets.against_first(capture)
            z.append(float(np.abs(offset[0] / std[0])))
            freedom = offsets.freedom(capture)
    if min(windows) < LEAST_STRETCHES * LEAST_WINDOWS:
        assert not z
        return
    # One in a hundred is beyond, by chance and by what stretches have in common some more.
    assert np.mean(np.array(z) > student_t.isf(0.005, freedom)) < 0.04
    assert np.mean(np.array(z) > student_t.isf(0.25, freedom)) > 0.3
