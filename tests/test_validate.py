"""`validate`: a run of an elastic axis predicted with parameters from another run, or of another axis."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.parse import parse_system
from sms_online.diagnosis.residuals import RowResidual
from sms_online.predicted import Predicted, PredictedTorque
from sms_online.validation import Validation
from sms_online.verdict.reasons import NOISE_RESIDUAL
from sms_tools.cli import main
from tests.one_link import one_link
from tests.test_compare import ELASTIC_AXIS, STIFFNESS
from tests.test_torque_gains import ARM

# Friction that the rig does not have, of so little damping that it does nothing beside 10 N m s/rad.
FRICTION = """
[[effect]]
name = "viscous_friction"
where = "joint_1"
[fitted]
"viscous_friction@joint_1.damping" = { value = -1e-3, std = %g }
"joint_1.stiffness" = { value = %g, std = 1.0 }
"""
NOISE = RowResidual(whitened=1.1, limit=1.3)
MORE = RowResidual(whitened=15.0, limit=1.3)


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
    assert found.deflections["joint_1"].left == pytest.approx(0.1, abs=0.03)
    assert found.deflections["joint_1"].least < 0.03


def test_a_torque_sensor_with_another_zero_is_said_with_its_size(rig: Path) -> None:
    system = sms.load_system(rig / "rig.toml")
    result = sms.estimate(system, rig / "monday.csv")
    tuesday = sms.read_capture(rig / "tuesday.csv")
    size = np.sqrt(np.mean(tuesday.values[:, tuesday.channels.index("tau_1")] ** 2))
    found = sms.validate(system, shifted(tuesday, "tau_1", 0.2 * size), result)
    assert found.verdict == "shifted"
    assert not found.holds
    joint = found.joints["joint_1"]
    assert joint.zero == pytest.approx(0.2 * size, rel=0.02)
    assert joint.left == pytest.approx(0.2, abs=0.03)
    assert joint.beside_zero < 0.02
    assert "tau_1 by +" in found.sentence


def shifted(capture: sms.Capture, channel: str, size: float) -> sms.Capture:
    """The same with another zero of one channel."""
    values = capture.values.copy()
    values[:, capture.channels.index(channel)] += size
    return replace(capture, values=values)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4])
def test_zeros_of_encoders_are_told_from_those_of_torques_by_tolerance(rig: Path, tolerance: float) -> None:
    system = sms.load_system(rig / "rig.toml")
    tuesday = sms.read_capture(rig / "tuesday.csv")
    # As much as the torque, by the spring.
    size = np.sqrt(np.mean(tuesday.values[:, tuesday.channels.index("tau_1")] ** 2)) / STIFFNESS
    scale = 1e-3 / size
    capture = shifted(tuesday, "q_1", size)
    result = sms.estimate(system, rig / "monday.csv")
    within = system.tolerances.model_copy(update={"encoder_zero": tolerance / scale})
    found = sms.validate(result.system.model_copy(update={"tolerances": within}), capture, result.parameters)
    joint = found.joints["joint_1"]
    assert joint.turned == pytest.approx(-size, rel=0.03)
    assert joint.holds == (tolerance == 1e-3)
    assert ("of the encoders beside the spring of joint_1 by" in found.sentence) != joint.holds


def test_a_zero_that_the_first_run_has_found_is_used(rig: Path) -> None:
    system = sms.load_system(rig / "rig.toml")
    monday, tuesday = (sms.read_capture(rig / f"{day}.csv") for day in ("monday", "tuesday"))
    size = 0.2 * np.sqrt(np.mean(tuesday.values[:, tuesday.channels.index("tau_1")] ** 2))
    result = sms.estimate(system, shifted(monday, "tau_1", size))
    (zero,) = (each for each in result.calibration if each.name == "drive_offset")
    assert zero.estimate == pytest.approx(size * system.joints[0].gear_ratio, rel=0.1)
    found = sms.validate(result.system, shifted(tuesday, "tau_1", size), result)
    assert found.holds
    assert not sms.validate(result.system, shifted(tuesday, "tau_1", size), result, calibration=()).holds


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
    assert set(document["deflections"]) == {"joint_1"}
    page = (out / "validation.html").read_text()
    assert "The parameters hold for the torques of this run" in page
    assert page.count("<figure>") == 2
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


@pytest.mark.slow
def test_true_parameters_hold_where_a_torque_is_mostly_noise() -> None:
    """A rigid arm whose torques are little beside their noise: grade B, seed 1."""
    arm = parse_system(ARM, "arm.toml")
    found = sms.validate(arm, sms.simulate(arm, grade="B", seed=1, duration=4.0))
    noisy = found.joints["joint_1"]
    assert noisy.left > NOISE_RESIDUAL
    assert noisy.rows is not None
    # Noise is predicted to a tenth, and 4 s are few windows.
    assert noisy.rows.whitened == pytest.approx(1.0, abs=0.3)
    assert found.verdict == "hold"
    assert "no more than noise" in found.sentence


@pytest.mark.parametrize(("std", "verdict"), [(1e-4, "impossible"), (1e-2, "hold")])
def test_a_negative_friction_is_impossible_however_well_it_predicts(rig: Path, std: float, verdict: str) -> None:
    text = ELASTIC_AXIS.format(stiffness=STIFFNESS) + FRICTION % (std, STIFFNESS)
    found = sms.validate(parse_system(text, "rig.toml"), rig / "tuesday.csv")
    assert all(each.holds for each in found.joints.values())
    assert found.verdict == verdict
    assert found.holds == (verdict == "hold")
    assert ("viscous_friction@joint_1.damping is negative" in found.sentence) == (verdict == "impossible")


def test_an_inertia_that_no_distribution_of_mass_has_is_impossible(rig: Path) -> None:
    fitted = '\n[fitted]\n"link_1.inertia" = { value = -1.5, std = 0.1 }\n'
    found = sms.validate(
        parse_system(ELASTIC_AXIS.format(stiffness=STIFFNESS) + fitted, "rig.toml"), rig / "tuesday.csv"
    )
    assert found.verdict == "impossible"
    assert "no distribution of mass has those of link_1" in found.sentence


@pytest.mark.parametrize(
    ("joint", "verdict"),
    [
        (PredictedTorque(0.25, 0.22, MORE), "unexplained"),
        (PredictedTorque(0.25, 0.22), "unexplained"),  # whatever its noise is
        (PredictedTorque(0.25, 0.22, NOISE), "hold"),
        (PredictedTorque(0.85, 0.29, NOISE), "weak"),
        (PredictedTorque(0.05, 0.045, MORE), "hold"),  # real rigs are never perfect
        (PredictedTorque(0.25, 0.15, MORE), "differ"),
        (PredictedTorque(0.25, 0.15, NOISE), "hold"),
        (PredictedTorque(0.25, 0.1, MORE, zero=0.4, zero_share=0.23), "shifted"),
        (PredictedTorque(0.25, 0.1, MORE, zero=0.4, zero_share=0.2), "differ"),
        (PredictedTorque(0.009, 0.001, MORE), "hold"),
    ],
)
def test_the_verdict_of_what_is_left(joint: PredictedTorque, verdict: str) -> None:
    found = Validation("rig", 5.0, {"joint_1": joint, "joint_2": PredictedTorque(0.001, 0.001, NOISE)})
    assert found.verdict == verdict
    assert found.holds == (verdict == "hold")
    assert ("run `sms-online diagnose`" in found.sentence) == (verdict == "unexplained")


def test_what_a_diagnosis_found_is_not_to_be_diagnosed_again() -> None:
    found = Validation("rig", 5.0, {"joint_1": PredictedTorque(0.25, 0.22, MORE)}, diagnosed=True)
    assert "unexplained in both: describe what acts there" in found.sentence


@pytest.mark.parametrize(
    ("deflection", "verdict"),
    [
        (Predicted(0.05, 0.01, MORE), "differ"),
        (Predicted(0.05, 0.01, NOISE), "hold"),
        (Predicted(0.05, 0.045, MORE), "hold"),
        (Predicted(0.25, 0.24, MORE), "unexplained"),
    ],
)
def test_deflections_are_part_of_the_verdict(deflection: Predicted, verdict: str) -> None:
    found = Validation(
        "rig", 5.0, {"joint_1": PredictedTorque(0.001, 0.001, NOISE)}, deflections={"link_1": deflection}
    )
    assert found.verdict == verdict
    assert ("elastic force of link_1" in found.sentence) == (verdict != "hold")


@pytest.mark.long
def test_rigidities_that_are_off_do_not_hold_where_torques_do() -> None:
    system = sms.load_system("paper-planar")
    capture = sms.simulate(system, duration=6.0, grade="A", seed=1)
    softer = tuple(
        link.model_copy(update={"flexural_rigidity_z": 0.7 * link.flexural_rigidity_z}) for link in system.links
    )
    found = sms.validate(system.model_copy(update={"links": softer}), capture)
    assert all(each.holds for each in found.joints.values())
    assert found.verdict == "differ"
    for link in ("link_1", "link_2"):
        assert found.deflections[link].left == pytest.approx(0.3 / 0.7, rel=0.05)
    assert sms.validate(system, capture).holds


def test_a_run_without_a_torque_is_refused(rig: Path) -> None:
    system, capture = sms.load_system(rig / "rig.toml"), sms.read_capture(rig / "tuesday.csv")
    values = capture.values.copy()
    values[:, capture.channels.index("tau_1")] = 0.0
    with pytest.raises(sms.InputError, match="no torque"):
        sms.validate(system, replace(capture, values=values))


def test_another_load_under_gravity_may_be_a_zero() -> None:
    joint = PredictedTorque(0.25, 0.1, MORE, "tau_1", zero=0.4, zero_share=0.23)
    assert "another load" in Validation("arm", 5.0, {"joint_1": joint}, gravity=True).sentence
    assert "another load" not in Validation("arm", 5.0, {"joint_1": joint}).sentence
