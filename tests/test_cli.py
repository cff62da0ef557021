"""The command line: what each verb prints, writes and returns."""

from __future__ import annotations

import csv
import json
import math
import re
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from sms_adapters.system_file import load_system
from sms_adapters.truth import truth_path, write_truth
from sms_online.description.parse import parse_system, shipped_text
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.estimator import Estimator
from sms_online.priors import base_prior
from sms_online.stream import Block
from sms_tools.cli import main
from tests.axis import AXIS, DAMPING, INERTIA, capture_lines
from tests.axis_bench import TRUTH, bench, document

__all__ = ["bench"]


def estimates(found: dict[str, Any]) -> dict[str, float]:
    return {p["name"]: p["estimate"] for p in found["parameters"]}


def python(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=60, **options)


# replay


def test_replay_prints_a_table_and_writes_the_document(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", "run.csv", "--system", "axis.toml", "--out", "done"]) == 0
    found = document(bench / "done")
    names = sorted(path.name for path in (bench / "done").iterdir())
    assert names == ["history.parquet", "report.html", "results.json"]
    assert list(found) == [
        "schema", "system", "samples", "duration_s", "method", "verdict", "parameters", "covariance",
        "scale_tolerance", "calibration", "trackers", "events", "residual", "physical", "condition_number",
        "throughput_samples_per_s", "lost_samples", "outliers", "warnings", "diagnosis", "history",
    ]  # fmt: skip
    assert found["schema"] == "sms-online/results/1"
    assert found["samples"] == 1200
    assert found["duration_s"] == pytest.approx(1199 / 200)
    assert estimates(found)["link_1.inertia"] == pytest.approx(INERTIA, rel=1e-4)
    assert found["residual"]["joint_1"]["relative"] < 1e-3
    out, err = capsys.readouterr()
    assert err == ""
    row = next(line for line in out.splitlines() if line.startswith("link_1.inertia"))
    assert "kg m²" in row
    assert "0.300" in row
    for line in ("residual joint_1: ", "condition number: ", "samples: 1200 in 5.995 s, 0 lost", "throughput: "):
        assert line in out
    assert "true" not in out.splitlines()[0]


def test_with_json_stdout_is_the_document_alone(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", "run.csv", "--system", "axis.toml", "--out", "done", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out) == document(bench / "done")
    assert "link_1.inertia" in err


def test_results_go_to_a_new_directory_for_each_run(bench: Path) -> None:
    for _ in range(3):  # within one second, which names the directory
        assert main(["replay", "run.csv", "--system", "axis.toml", "-to", "1.5"]) == 0
    assert len(list((bench / "runs").glob("*/results.json"))) == 3


@pytest.mark.slow
def test_the_truth_reaches_the_report_and_never_the_estimate(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", "run.csv", "--system", "axis.toml", "--out", "without"]) == 0
    names = [parameter.name for parameter in build_model(load_system("axis.toml")).parameters]
    wrong = {name: 2.0 * TRUTH.get(name, 0.0) for name in names}
    write_truth(bench / "run.csv", wrong, {})
    capsys.readouterr()
    assert main(["replay", "run.csv", "--system", "axis.toml", "--out", "with"]) == 0
    without, with_truth = document(bench / "without"), document(bench / "with")
    assert estimates(without) == estimates(with_truth)
    assert all(p["true"] is None for p in without["parameters"])
    assert {p["name"]: p["true"] for p in with_truth["parameters"]} == {name: wrong[name] for name in TRUTH}
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("link_1.inertia"))
    assert row.endswith("-50")


def test_a_truth_of_other_parameters_is_not_compared(bench: Path) -> None:
    write_truth(bench / "run.csv", {"link_1.inertia": INERTIA}, {})
    assert main(["replay", "run.csv", "--system", "axis.toml", "--out", "done"]) == 0
    found = document(bench / "done")
    assert all(p["true"] is None for p in found["parameters"])
    assert any(warning.startswith("no comparison with the truth") for warning in found["warnings"])


def test_start_and_stop_choose_the_samples(bench: Path) -> None:
    assert main(["replay", "run.csv", "--system", "axis.toml", "--out", "done", "-ss", "1", "-to", "4.5"]) == 0
    found = document(bench / "done")
    assert found["samples"] == 700
    assert found["duration_s"] == pytest.approx(699 / 200)
    assert estimates(found)["link_1.inertia"] == pytest.approx(INERTIA, rel=1e-4)


@pytest.mark.slow
def test_replay_in_step_with_the_clock_changes_no_bit(bench: Path) -> None:
    short = ["replay", "run.csv", "--system", "axis.toml", "-to", "1.5"]
    assert main([*short, "--out", "fast"]) == 0
    start = perf_counter()
    assert main([*short, "--out", "paced", "--speed", "1"]) == 0
    assert perf_counter() - start > 1.49
    assert document(bench / "fast")["parameters"] == document(bench / "paced")["parameters"]


@pytest.mark.slow
def test_channels_that_the_model_does_not_use_are_named(bench: Path) -> None:
    (bench / "free.toml").write_text(AXIS + "[spacecraft]\nmass = 5.0\ninertia = { zz = 1.0 }\n")
    header, *lines = capture_lines(2.0)
    extra = [",".join(f"{math.sin(0.01 * j * k)}" for j in (1, 2, 3, 4)) for k in range(len(lines))]
    rows = [f"{line},{cells}" for line, cells in zip(lines, extra, strict=True)]
    (bench / "run.csv").write_text("\n".join([f"{header},r_S_x,r_S_y,theta_0,gyro_0_z", *rows]) + "\n")
    assert main(["replay", "run.csv", "--system", "free.toml", "--out", "done"]) in (0, 3)
    assert "unused channels: gyro_0_z" in document(bench / "done")["warnings"]


@pytest.mark.slow
@pytest.mark.parametrize("small", [0, 20_000_000])
def test_a_terminal_has_a_bar_for_what_takes_more_than_a_moment(
    bench: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], small: int
) -> None:
    check = ["check", "run.csv", "--system", "axis.toml"]
    monkeypatch.setattr("sms_tools.waiting.SMALL", small)
    for colour, moment in ((None, 0.0), ("1", 1e6)):  # no terminal, then nothing that takes so long
        if colour is not None:
            monkeypatch.setenv("FORCE_COLOR", colour)  # rich takes it for a terminal
        monkeypatch.setattr("sms_tools.waiting.MOMENT", moment)
        assert main(check) == 0
        assert capsys.readouterr().err == ""
    monkeypatch.setattr("sms_tools.waiting.MOMENT", 0.0)
    assert main(check) == 0
    shown = capsys.readouterr().err
    assert "run.csv" in shown
    assert re.search(r"\d:\d\d:\d\d", shown)  # the time left


@pytest.mark.slow
def test_every_verb_that_takes_long_has_a_bar(
    bench: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr("sms_tools.waiting.MOMENT", 0.0)
    capture = ["run.csv", "--system", "axis.toml"]
    verbs: list[tuple[list[str], list[str]]] = [
        (["replay", *capture, "-to", "2", "--out", "done"], ["run.csv"]),
        (["bound", *capture], ["run.csv"]),
        (["validate", *capture, "--out", "done"], ["run.csv"]),
        (["diagnose", *capture, "--out", "done"], ["run.csv", "fitting the model"]),
        (["simulate", "--system", "moved.toml", "--capture", "new.csv", "--duration", "1"], ["solving the motion"]),
        (["bound", "--system", "moved.toml"], ["solving the motion"]),
        (["excite", "--system", "moved.toml", "--iterations", "1", "--out", "done"], ["designing the motion"]),
    ]
    for verb, said in verbs:
        assert main(verb) in (0, 3)  # without noise there is no bound
        shown = capsys.readouterr().err
        assert all(what in shown for what in said)


@pytest.mark.parametrize(("presses", "written"), [(1, True), (2, False)])
def test_ctrl_c_finishes_with_what_has_been_read(
    bench: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], presses: int, written: bool
) -> None:
    push, pushed = Estimator.push, 0

    def press(self: Estimator, block: Block) -> None:
        nonlocal pushed
        push(self, block)
        pushed += block.t.size
        if pushed >= 500:
            for _ in range(presses):
                signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Estimator, "push", press)
    monkeypatch.setattr("sms_tools.verbs.replay.PIECE", 100)
    before = signal.getsignal(signal.SIGINT)
    assert main(["replay", "run.csv", "--system", "axis.toml", "--out", "done"]) == 130
    assert signal.getsignal(signal.SIGINT) is before
    assert "interrupted" in "".join(capsys.readouterr())
    assert (bench / "done").exists() == written
    if written:
        assert document(bench / "done")["samples"] == 500


# priors


def test_a_stated_prior_holds_without_the_option() -> None:
    system = parse_system(AXIS + '[prior."link_1.inertia"]\nvalue = 0.5\nstd = 0.05\n', "axis.toml")
    base = find_base_parameters(build_model(system))
    names = [parameter.name for parameter in base.parameters]
    inertia, damping = names.index("link_1.inertia"), names.index("viscous_friction@joint_1.damping")
    stated, nominal = base_prior(system, base, prior=False), base_prior(system, base, prior=True)
    for prior in (stated, nominal):
        assert (prior.value[inertia], prior.std[inertia]) == (0.5, 0.05)
    assert math.isnan(stated.std[damping])
    assert (nominal.value[damping], nominal.std[damping]) == (DAMPING, pytest.approx(0.1 * DAMPING))


def test_a_combination_has_a_prior_when_all_of_it_has() -> None:
    text = shipped_text("paper-planar")
    half = text + '[prior]\n"spacecraft.mass" = { value = 400.0, std = 3.0 }\n'
    whole = half + '"motor_1.mass" = { value = 3.0, std = 4.0 }\n'
    for description, std in ((half, math.nan), (whole, 5.0)):
        system = parse_system(description, "paper.toml")
        base = find_base_parameters(build_model(system))
        prior = base_prior(system, base, prior=False)
        k = [parameter.name for parameter in base.parameters].index("spacecraft.mass_with_motor_1")
        assert prior.std[k] == pytest.approx(std, nan_ok=True)
        assert prior.known.sum() == (0 if math.isnan(std) else 1)
    assert prior.value[k] == 403.0


@pytest.mark.slow
def test_a_prior_decides_what_the_motion_does_not(bench: Path) -> None:
    # At constant speed friction alone takes work; the kinetic energy never changes.
    rows = [f"{k / 200},{DAMPING * 0.5},{0.5 * k / 200}" for k in range(1200)]
    (bench / "run.csv").write_text("\n".join(["t,force_1,q_1", *rows]) + "\n")
    # An unknown offset of the force would take the same work.
    exact = 'tolerances = "none"\n' + AXIS
    (bench / "exact.toml").write_text(exact)
    (bench / "prior.toml").write_text(exact + '[prior."link_1.inertia"]\nvalue = 0.31\nstd = 0.01\n')
    assert main(["replay", "run.csv", "--system", "exact.toml", "--out", "without"]) == 0
    assert main(["replay", "run.csv", "--system", "prior.toml", "--out", "with"]) == 0
    flags = {p["name"]: p["identifiable"] for p in document(bench / "without")["parameters"]}
    assert flags == {"link_1.inertia": False, "viscous_friction@joint_1.damping": True}
    assert estimates(document(bench / "with"))["link_1.inertia"] == pytest.approx(0.31, abs=1e-3)


# import, markers


def test_import_writes_a_capture_and_clears_a_truth_of_another(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    t = np.arange(50) / 1000.0
    savemat(bench / "emps.mat", {"t": t, "qm": np.sin(t), "qg": np.sin(t), "vir": np.cos(t), "gtau": 35.15})
    write_truth(bench / "emps.csv", {}, {})
    assert main(["import", "emps", "emps.mat", "--capture", "emps.csv", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["samples"] == 50
    with (bench / "emps.csv").open() as file:
        assert next(csv.reader(file)) == ["t", "force_1", "q_1"]
    assert not truth_path(bench / "emps.csv").exists()


def test_an_import_never_writes_over_its_source(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (bench / "log.csv").write_text("t,tau_1\n0,1\n")
    assert main(["import", "log", "log.csv", "--system", "paper-planar", "--capture", "./log.csv"]) == 2
    assert "the source itself; expected another file" in capsys.readouterr().err
    assert (bench / "log.csv").read_text() == "t,tau_1\n0,1\n"


def test_markers_of_the_papers_links(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["markers", "--system", "paper-planar", "--json"]) == 0
    out, err = capsys.readouterr()
    for link in json.loads(out)["links"]:
        assert (link["markers_required"], link["markers_described"]) == (2, 2)
        assert link["f_s"] == 2 * max(mode["spatial_frequency"] for mode in link["modes"])
        assert len(link["modes"]) == 2
    assert "link_2  bending_z" in err
    assert main(["markers", "--system", "paper-planar", "--modes", "4"]) == 0
    assert capsys.readouterr().out.count("bending_z") == 8
    assert main(["markers", "--system", "axis.toml"]) == 0
    assert capsys.readouterr().out == "axis: no flexible link that bends\n"


# the program as a process


@pytest.mark.slow
def test_the_program_runs_as_a_module_and_helps(bench: Path) -> None:
    said = python("-m", "sms_online", "--help")
    assert said.returncode == 0
    for verb in ("demo", "simulate", "replay", "import", "markers"):
        assert f"\n    {verb} " in said.stdout
    assert python("-m", "sms_tools", "replay", "--help").returncode == 0
    wrong = python("-m", "sms_tools", "replay", "run.csv", "--system", "axis.tom")
    assert (wrong.returncode, wrong.stdout) == (2, "")


def test_the_command_line_comes_without_numpy() -> None:
    code = "import sys, sms_tools.cli; print('numpy' in sys.modules)"
    assert python("-c", code).stdout == "False\n"


@pytest.mark.slow
def test_a_reader_that_leaves_early_is_no_error(bench: Path) -> None:
    replay = ["replay", "run.csv", "--system", "axis.toml", "-to", "2", "--out", "done"]
    process = subprocess.Popen(
        [sys.executable, "-m", "sms_tools", *replay], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait(timeout=60) == 0
    assert (bench / "done" / "results.json").exists()


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"sms-online {version('sms-online')}\n"


@pytest.mark.parametrize(
    ("typed", "completed"),
    [("sms-online rep", "replay"), ("sms-online replay --ad", "--adopt"), ("sms-online replay ru", "run.csv")],
)
def test_bash_completes_verbs_options_and_files(
    bench: Path, capsys: pytest.CaptureFixture[str], typed: str, completed: str
) -> None:
    assert main(["--print-completion", "bash"]) == 0
    script = capsys.readouterr().out
    words = typed.split()
    state = f"COMP_WORDS=({typed}); COMP_CWORD={len(words) - 1}; COMP_LINE={typed!r}; COMP_POINT={len(typed)}"
    function = "$(complete -p sms-online | sed 's/.*-F \\([^ ]*\\).*/\\1/')"
    call = f'{state}; {function} sms-online {words[-1]} {words[-2]}; printf "%s\\n" "${{COMPREPLY[@]}}"'
    done = subprocess.run(["bash", "-c", f"{script}\n{call}"], cwd=bench, capture_output=True, text=True, timeout=60)
    assert completed in done.stdout.split(), done.stderr
