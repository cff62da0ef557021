"""The verbs `simulate` and `demo`: what they write, and what a replay makes of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sms_adapters.truth import truth_path
from sms_online.description.parse import shipped_text
from sms_tools.cli import main
from tests.axis_bench import MOVED, TRUTH, bench, document

__all__ = ["bench"]


def test_a_simulation_is_replayed_to_its_truth(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulated = ["simulate", "--system", "moved.toml", "--capture", "sim.csv", "--duration", "4", "--grade", "A"]
    assert main([*simulated, "--seed", "3", "--json"]) == 0
    out, err = capsys.readouterr()
    said = json.loads(out)
    assert said["samples"] == 801
    assert said["drift"]["energy"] < 1e-8
    assert said["drift"]["linear_momentum"] is None
    assert "energy drift" in err
    truth = json.loads(truth_path(bench / "sim.csv").read_text())
    assert (truth["system"], truth["grade"], truth["seed"], truth["duration_s"]) == ("axis", "A", 3, 4.0)
    assert truth["parameters"].items() >= TRUTH.items()
    assert main(["replay", "sim.csv", "--system", "moved.toml", "--out", "done"]) == 0
    for p in document(bench / "done")["parameters"]:
        assert abs(p["estimate"] - p["true"]) < 4.0 * p["std"]


def test_a_trajectory_that_no_controller_follows_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = shipped_text("paper-planar")
    start = text.index("[controller]")
    Path("free.toml").write_text(text[:start] + text[text.index("[trajectory]") :])
    assert main(["simulate", "--system", "free.toml", "--capture", "sim.csv"]) == 2
    assert "controller: no such table; expected gains that follow [trajectory]" in capsys.readouterr().err
    assert not Path("sim.csv").exists()


def test_a_simulation_of_an_arm_that_nothing_moves_says_so(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "--system", "axis.toml", "--capture", "sim.csv", "--duration", "1"]) == 0
    assert "no motor moves: axis.toml has no [trajectory]" in capsys.readouterr().out


def test_the_seed_decides_the_capture(bench: Path) -> None:
    def capture(seed: str) -> bytes:
        arguments = ["simulate", "--system", "moved.toml", "--capture", "sim.csv", "--duration", "1", "--grade", "B"]
        assert main([*arguments, "--seed", seed]) == 0
        return (bench / "sim.csv").read_bytes()

    assert capture("1") == capture("1")
    assert capture("1") != capture("2")


@pytest.mark.slow
def test_the_demo_shows_the_papers_parameters_converge(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (bench / "paper.toml").write_text(shipped_text("paper-planar").replace("duration = 20.0", "duration = 3.0"))
    assert main(["demo", "--system", "paper.toml", "--out", "done"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert out.splitlines()[0] == "solving the arm's motion ahead …"
    assert " of 16 parameters determined" in out.splitlines()[1]
    parameters = document(bench / "done")["parameters"]
    assert [p["name"] for p in parameters] == [
        "spacecraft.inertia_about_joint_1", "spacecraft.first_moment_x", "spacecraft.first_moment_y",
        "spacecraft.mass_with_motor_1", "motor_1.rotor_inertia", "motor_2.rotor_inertia", "motor_2.stator_inertia",
        "motor_2.mass", "link_1.mass_per_length", "link_2.mass_per_length", "link_1.flexural_rigidity",
        "link_2.flexural_rigidity", "joint_1.stiffness", "joint_2.stiffness", "joint_1.damping", "joint_2.damping",
    ]  # fmt: skip
    # Samples come through a real bus and their times through estimated clocks; three seconds of them, on any machine.
    assert np.median([abs(p["estimate"] / p["true"] - 1.0) for p in parameters]) < 0.1


@pytest.mark.long
def test_at_a_terminal_the_demo_draws_its_table_again_and_again(
    bench: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (bench / "moved.toml").write_text(MOVED.replace("duration = 6.0", "duration = 2.0"))
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr("sms_tools.verbs.demo.TABLE_INTERVAL", 0.0)
    assert main(["demo", "--system", "moved.toml", "--out", "done"]) == 0
    out = capsys.readouterr().out
    # The first second waits for the clocks.
    assert "1.0 of 2 s" in out
    assert "2.0 of 2 s" in out
    assert out.count("link_1.inertia") >= 10
    assert str(Path("done") / "results.json") in out
    assert str(Path("done") / "report.html") in out
    verdict, then = out.rstrip().splitlines()[-2:]
    assert verdict.removeprefix("\x1b[1;90m").startswith("Not yet: ")
    assert then.startswith("  next: ")
