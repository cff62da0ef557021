"""Diagnosis of measured data: the EMPS axis from its mass alone, the Quanser rig without the friction it has."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sms_adapters.importers import import_emps, import_quanser
from sms_online.description.parse import parse_system, shipped_text
from sms_tools.cli import main

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
EMPS = DATA / "emps" / "DATA_EMPS.mat"
QUANSER = DATA / "quanser_2dsfl" / "lqr_full_10deg.mat"


def diagnosis(out: Path, *arguments: str) -> dict[str, Any]:
    assert main(["diagnose", *arguments, "--out", str(out)]) == 0
    document: dict[str, Any] = json.loads((out / "diagnosis.json").read_text())
    return document


def test_the_friction_of_emps_is_found_from_its_mass_alone(tmp_path: Path) -> None:
    """Published: 95.11 kg, 20.39 N and 203.5 N s/m, which leave 4.08 % of the force, with friction by no direction."""
    if not EMPS.exists():
        pytest.skip(f"measured data {EMPS.name} is not beside the checkout")
    import_emps(EMPS, tmp_path / "emps.csv")
    text = shipped_text("emps")
    bare = text[: text.index("[[effect]]")] + text[text.index("[[sensor]]") :]
    (tmp_path / "mass.toml").write_text(bare)
    document = diagnosis(tmp_path / "out", str(tmp_path / "emps.csv"), "--system", str(tmp_path / "mass.toml"))
    found = {effect["name"]: effect["coefficients"] for effect in document["effects"]}
    assert {"coulomb_friction", "direction_friction"} <= set(found)
    assert found["coulomb_friction"]["torque"]["estimate"] == pytest.approx(20.3935, rel=0.03)
    viscous = [found["direction_friction"][side]["estimate"] for side in ("plus", "minus")]
    assert sum(viscous) / 2.0 == pytest.approx(203.5034, rel=0.03)
    mass = document["after"]["parameters"][0]
    assert mass["estimate"] == pytest.approx(95.1089, rel=0.005)
    assert document["before"]["holdout"]["joint_1"]["relative"] > 0.5
    assert document["after"]["holdout"]["joint_1"]["relative"] < 0.033
    # The file with what was found is a system of its own.
    adopted = parse_system((tmp_path / "out" / "system.toml").read_text(), "system.toml")
    assert {effect.name for effect in adopted.effects} == set(found)


def test_the_friction_that_was_left_out_of_the_quanser_rig_is_found(tmp_path: Path) -> None:
    """Fitted to the first half, checked on the second: hub 1 falls from nearly all of the torque to below a quarter."""
    if not QUANSER.exists():
        pytest.skip(f"measured data {QUANSER.name} is not beside the checkout")
    capture = str(tmp_path / "quanser.csv")
    import_quanser(QUANSER, Path(capture))
    arguments = (capture, "--system", "quanser-2dsfl", "--prior", "-to", "10", "--holdout", capture)
    document = diagnosis(tmp_path / "out", *arguments)
    joints = {effect["where"] for effect in document["effects"] if effect["name"].endswith("_friction")}
    assert joints == {"joint_1", "joint_2"}
    before, after = (document[side]["holdout"] for side in ("before", "after"))
    assert before["joint_1"]["relative"] > 0.9
    assert after["joint_1"]["relative"] < 0.25
    assert after["joint_2"]["relative"] < 0.5 * before["joint_2"]["relative"]


def test_a_holdout_that_is_the_capture_itself_needs_an_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = tmp_path / "capture.csv"
    capture.write_text("t,force_1,q_1\n" + "".join(f"{k / 1000},0,0\n" for k in range(2000)))
    arguments = [str(capture), "--system", "emps", "--holdout", str(capture), "--out", str(tmp_path / "out")]
    assert main(["diagnose", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "-to SECONDS" in line
