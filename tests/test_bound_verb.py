"""bound and replay --bound on the command line."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.parse import shipped_systems, shipped_text
from sms_sim.bound import noisy_sensors
from sms_sim.plant import Plant
from sms_tools.cli import main

SENSORS = """
[[sensor]]
channels = ["tau_*"]
noise = 0.01

[[sensor]]
channels = ["theta_m_*", "q_*"]
resolution = 4.793689962142629e-5 # 17 bits a turn

[[sensor]]
channels = ["r_S_*", "theta_0"]
rate = 240.0
noise = 1e-4
"""


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """The paper's example for 0.4 s, with encoders, torques and the base alone."""
    text = shipped_text("paper-planar").replace("duration = 20.0", "duration = 0.4")
    start, end = text.index("[[sensor]]"), text.index("[controller]")
    path = tmp_path / "rig.toml"
    path.write_text(text[:start] + SENSORS + text[end:], encoding="utf-8")
    return path


@pytest.mark.long
def test_bounds_rise_with_the_noise_and_without_a_sensor(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bound", "--system", str(rig), "--each-sensor", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "sms-online/bound/1"
    for p in document["parameters"]:
        assert set(p["bound_without"]) == {"theta_m_*, q_*", "r_S_*, theta_0"}
        for without in p["bound_without"].values():
            assert without is None or without > p["bound"] * (1.0 - 1e-6)
    bounds = []
    for grade in "AB":
        assert main(["bound", "--system", str(rig), "--grade", grade, "--json"]) == 0
        parameters = json.loads(capsys.readouterr().out)["parameters"]
        bounds.append({p["name"]: p["bound"] for p in parameters})
    assert all(bounds[1][name] > 4.0 * bounds[0][name] for name in bounds[0])


# All that have a trajectory; ak80-pendulum states its noise.
WITHOUT_NOISE = (
    "emps", "paper-planar", "paper-planar-exact", "paper-planar-table-v", "seven-joint", "spatial-two-link",
)  # fmt: skip


@pytest.mark.parametrize("name", shipped_systems())
def test_sensors_of_every_shipped_system_have_noise(name: str) -> None:
    system = load_system(name)
    sensors, grade = noisy_sensors(Plant(system), None)
    assert grade == (None if name == "ak80-pendulum" else "B")
    assert np.all(np.concatenate((sensors.density, sensors.torque)) > 0.0)
    assert (system.trajectory is None) == (name not in (*WITHOUT_NOISE, "ak80-pendulum"))


@pytest.mark.long
@pytest.mark.parametrize("name", WITHOUT_NOISE)
def test_a_system_without_stated_noise_has_bounds_of_grade_b(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "system.toml"
    path.write_text(re.sub(r"(?m)^duration = .*", "duration = 0.4", shipped_text(name)), encoding="utf-8")
    assert main(["bound", "--system", str(path), "--json"]) == 0
    out, said = capsys.readouterr()
    assert f"noise: grade B, for {path} does not state that of every sensor" in said
    assert main(["bound", "--system", str(path), "--json", "--grade", "B"]) == 0
    same, said = capsys.readouterr()
    assert same == out
    assert json.loads(out)["grade"] == "B"
    assert "noise: " not in said


@pytest.mark.slow
def test_a_replay_states_the_bound_on_demand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = tmp_path / "capture.csv"
    arguments = ["--system", "paper-planar", "--capture", str(capture), "--duration", "2", "--grade", "B"]
    assert main(["simulate", *arguments]) == 0
    capsys.readouterr()
    documents = []
    for options in ([], ["--bound"]):
        out = ["--out", str(tmp_path / "run"), "--json"]
        assert main(["replay", str(capture), "--system", "paper-planar", *out, *options]) == 0
        documents.append(json.loads(capsys.readouterr().out)["parameters"])
    without, with_bound = documents
    assert all(p["bound"] is None for p in without)
    assert [p["estimate"] for p in without] == [p["estimate"] for p in with_bound]
    # No honest error bar is below the bound; both come from noise estimated to some percent.
    assert all(p["std"] > 0.9 * p["bound"] for p in with_bound)
    assert main(["bound", str(capture), "--system", "paper-planar", "--json"]) == 0
    alone = json.loads(capsys.readouterr().out)["parameters"]
    assert [p["bound"] for p in alone] == [p["bound"] for p in with_bound]
    assert main(["bound", str(capture), "--system", "paper-planar", "--grade", "A"]) == 2
