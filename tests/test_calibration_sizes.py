"""What sessions of the planar example are wrong in is said with its size, and the parameters are as without it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sms_online as sms
from sms_adapters.system_file import load_system
from sms_online.calibration.columns import nuisances
from sms_online.description.schema import Tolerances
from sms_online.effects.build import build_model
from sms_online.evaluation import NORMAL_95
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.sensing import Sensing
from sms_sim.plant import Plant
from tests.campaigns.calibration import SYSTEM, WITHIN, one_session
from tests.campaigns.sessions import true_parameters

SEED = 1
# Of those that are each off by so many sines and cosines some are too small for their bars.
SAID = {"once per turn 1e-4": 5}
# Share of 95 % intervals of one session, whose errors are not independent.
COVERED = 0.8


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Holds the exact samples, which are made once."""
    return tmp_path_factory.mktemp("exact")


@pytest.mark.long
@pytest.mark.parametrize(
    "kind",
    [
        "camera 50 us", "camera 0.5 ms", "camera 4 ms", "tracked point 1 mm", "tracked point 5 mm",
        "marker zero 1e-4", "once per turn 1e-4",
    ],
)  # fmt: skip
def test_what_is_off_is_said_with_its_size(folder: Path, kind: str) -> None:
    record = one_session(folder, kind, "default", SEED)
    found = {tuple(key): (value, std) for *key, value, std in record["nuisances"]}
    for *key, true, _ in record["true"]:
        value, std = found[tuple(key)]
        assert abs(value - true) < WITHIN * std, key
    said = [certain for *_, certain in record["true"]]
    assert sum(said) >= SAID.get(kind, len(said))
    z = np.abs((np.array(record["estimate"]) - true_parameters(load_system(SYSTEM))) / np.array(record["std"]))
    assert np.mean(z < NORMAL_95) >= COVERED
    assert z.max() < 3.5


def test_a_zero_of_the_attitude_adds_to_what_is_on_the_base() -> None:
    """S is 1 m and 2 m from joint 1 along the axes of the base."""
    system = load_system(SYSTEM).model_copy(update={"tolerances": Tolerances()})
    model = build_model(system)
    every = nuisances(Sensing(model, Plant(system).channels, "test"))
    known = {(each.name, each.where, each.part): each.tolerance for each in every}
    assert known["tracked_point", "base", "x"] == pytest.approx(np.hypot(5e-4, 2e-3))
    assert known["tracked_point", "base", "y"] == pytest.approx(np.hypot(5e-4, 1e-3))
    assert known["axis", "joint_1", "z"] == pytest.approx(np.hypot(5e-4, 1e-3))
    assert known["axis", "joint_2", "z"] == 5e-4


@pytest.mark.long
def test_a_slope_stated_a_little_wrong_is_corrected() -> None:
    """A table whose slope is stated 3 % wrong: it is a tolerance of gravity, and no parameter is off by it. Seed 3."""
    planar = sms.load_system("paper-planar")
    data = sms.simulate(planar.model_copy(update={"gravity": (0.003, -0.002, 0.0)}), duration=24.0, grade="B", seed=3)
    result = sms.estimate(planar.model_copy(update={"gravity": (0.0031, -0.002, 0.0)}), data)
    model = build_model(planar)
    true = find_base_parameters(model).values(model.nominal)
    for parameter, value in zip(result.parameters.values(), true, strict=True):
        assert parameter.value == pytest.approx(value, abs=4.0 * parameter.std), parameter.name
    assert result.trust.level == "trust"
