"""`compare`: ten sessions of an elastic axis, of which three have 1 % less stiffness."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

import sms_online as sms
from sms_tools.cli import main

STIFFNESS = 450.0  # N m/rad
SOFTER = (2, 5, 6)  # sessions
ELASTIC_AXIS = """
name = "elastic axis"
motion = "planar"
sample_rate = 500.0
[joint_1]
stiffness = {stiffness}
damping = 10.0
gear_ratio = 20.0
[motor_1]
rotor_inertia = 1e-3
[link_1]
kind = "rigid"
inertia = {{ zz = 1.5 }}
[controller]
stiffness = [40.0]
damping = [5.0]
[trajectory]
duration = 6.0
joint_1 = [{{ frequency = 4.0, sine = 2.0 }}, {{ frequency = 9.0, cosine = 1.0 }}]
"""


pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Folders of runs, in their order; the description is that of the first."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "rig.toml").write_text(ELASTIC_AXIS.format(stiffness=STIFFNESS))
    out = []
    for seed in range(10):
        rig = sms.load_system(folder / "rig.toml")
        soft = rig.model_copy(update={"joints": (rig.joints[0].model_copy(update={"stiffness": 0.99 * STIFFNESS}),)})
        capture = sms.write_capture(
            sms.simulate(soft if seed in SOFTER else rig, grade="A", seed=seed), folder / f"{seed}.csv"
        )
        out.append(folder / f"run-{seed}")
        assert main(["replay", str(capture), "--system", str(folder / "rig.toml"), "--out", str(out[-1])]) == 0
    return out


def test_three_softer_sessions_are_marked_and_no_other(runs: list[Path]) -> None:
    compared = sms.compare(runs)
    assert compared.changed == tuple(f"run-{seed}" for seed in SOFTER)
    (name,) = (name for name, each in compared.parameters.items() if each.changes)
    assert name == "joint_1.stiffness"
    for change in compared.parameters[name].changes:
        assert change.size == pytest.approx(-0.01 * STIFFNESS, rel=0.1)


def test_sessions_alike_show_no_change(runs: list[Path]) -> None:
    assert sms.compare([run for seed, run in enumerate(runs) if seed not in SOFTER]).changed == ()


def test_the_verb_writes_a_table_and_a_page(
    runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert main(["compare", *map(str, runs), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "Changed in run-2, run-5, run-6: joint_1.stiffness." in said
    document = json.loads((tmp_path / "comparison.json").read_text())
    assert document["changed"] == ["run-2", "run-5", "run-6"]
    page = (tmp_path / "comparison.html").read_text()
    assert page.count("<svg") == len(document["parameters"]) + len(document["calibration"])
    assert re.search(r"run-5</b>: -(1|0\.9\d*) %", page)


def test_what_is_no_result_is_named(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "results.json").write_text('{"schema": "another"}')
    for other, expected in ((tmp_path, "no results of a session"), (tmp_path / "absent", "No such file")):
        capsys.readouterr()
        assert main(["compare", str(runs[0]), str(other), "--out", str(tmp_path / "out")]) == 2
        said = capsys.readouterr().err
        assert expected in said
        assert said.count("\n") == 1
    assert main(["compare", str(runs[0]), str(runs[0]), "--out", str(tmp_path / "out")]) == 2
    assert "twice" in capsys.readouterr().err
