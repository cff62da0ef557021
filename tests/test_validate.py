"""`validate`: a run of an elastic axis predicted with parameters from another run, or of another axis."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import sms_online as sms
from sms_tools.cli import main
from tests.one_link import one_link
from tests.test_compare import ELASTIC_AXIS, STIFFNESS


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with rig.toml, whose stiffness is 10 % off, a run on Monday and one on Tuesday of the true rig."""
    folder = tmp_path_factory.mktemp("rig")
    (folder / "rig.toml").write_text(ELASTIC_AXIS.format(stiffness=1.1 * STIFFNESS))
    true = sms.load_system(folder / "rig.toml")
    true = true.model_copy(update={"joints": (true.joints[0].model_copy(update={"stiffness": STIFFNESS}),)})
    for seed, day in enumerate(("monday", "tuesday")):
        sms.write_capture(sms.simulate(true, grade="A", seed=seed), folder / f"{day}.csv")
    return folder


def test_parameters_of_one_run_hold_on_another(rig: Path) -> None:
    result = sms.estimate(sms.load_system(rig / "rig.toml"), rig / "monday.csv")
    found = sms.validate(result.system, rig / "tuesday.csv", result.parameters)
    assert found.holds
    assert list(found.joints) == ["joint_1"]
    assert found.joints["joint_1"].left < 0.02
    assert found.joints["joint_1"].least <= found.joints["joint_1"].left


def test_a_stiffness_that_is_off_does_not_hold(rig: Path) -> None:
    found = sms.validate(sms.load_system(rig / "rig.toml"), rig / "tuesday.csv")
    assert not found.holds
    assert found.joints["joint_1"].left > 0.03
    assert "do not hold" in found.sentence


@pytest.mark.slow
def test_the_verb_takes_the_folder_of_a_run(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = rig / "run", rig / "out"
    assert main(["replay", str(rig / "monday.csv"), "--system", str(rig / "rig.toml"), "--out", str(run)]) == 0
    capsys.readouterr()
    arguments = [str(rig / "tuesday.csv"), "-ss", "1", "--out", str(out), "--json"]
    assert main(["validate", *arguments, "--system", str(run)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((out / "validation.json").read_text())
    assert document["holds"]
    assert document["duration_s"] == pytest.approx(5.0, abs=0.01)
    assert main(["validate", *arguments, "--system", str(rig / "rig.toml")]) == 0
    assert not json.loads(capsys.readouterr().out)["holds"]


def test_a_parameter_without_a_value_is_refused(rig: Path) -> None:
    with pytest.raises(sms.InputError, match="a value of every parameter"):
        sms.validate(sms.load_system(rig / "rig.toml"), rig / "tuesday.csv", {"joint_1.stiffness": STIFFNESS})


def test_a_link_whose_shape_is_not_measured_is_predicted_as_well() -> None:
    system = one_link("linear")
    capture = sms.simulate(system, duration=3.0, seed=1)
    found = sms.validate(system, capture)
    assert list(found.joints) == ["joint_1"]
    assert 0.0 < found.joints["joint_1"].least <= found.joints["joint_1"].left
