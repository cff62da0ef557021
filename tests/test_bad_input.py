"""Bad input: one line that says what is wrong and where, the right exit code, and nothing half-written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sms_adapters.truth import truth_path
from sms_tools.cli import main
from tests.axis import AXIS, DAMPING, INERTIA, capture_lines

FLEXIBLE_LINK = """
[link_1]
kind = "flexible"
length = 0.0
elements = 1
mass_per_length = 1.0
flexural_rigidity_z = 10.0
deformations = ["bending_z"]
"""


def joints(n: int) -> str:
    """Tables of more axes, n in all."""
    table = '[joint_{0}]\ntransmission = "rigid"\n[link_{0}]\nkind = "rigid"\ninertia = {{ zz = 1.0 }}\n'
    return "".join(table.format(i) for i in range(2, n + 1))


def elements(n: int) -> str:
    """Tables of a second axis whose link has so many elements."""
    link = FLEXIBLE_LINK.replace("link_1", "link_2").replace("0.0", "1.0", 1)
    return '[joint_2]\ntransmission = "rigid"' + link.replace("elements = 1", f"elements = {n}")


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with a good system and a good capture."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "axis.toml").write_text(AXIS)
    (tmp_path / "run.csv").write_text("\n".join(capture_lines()) + "\n")
    return tmp_path


def refusal(bench: Path, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line on stderr of a run that ends with 2 and leaves the directory as it was."""
    before = {path: path.stat().st_mtime_ns for path in bench.rglob("*")}
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("sms-online")
    assert err.count("\n") == 1
    assert {path: path.stat().st_mtime_ns for path in bench.rglob("*")} == before
    return err


def replayed(bench: Path, capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, dict[str, Any]]:
    """Exit code and results of replaying run.csv."""
    code = main(["replay", "run.csv", "--system", "axis.toml", "--out", "done", "--json", *options])
    capsys.readouterr()
    return code, json.loads((bench / "done" / "results.json").read_text())


def assert_right(document: dict[str, Any]) -> None:
    estimates = {p["name"]: p["estimate"] for p in document["parameters"]}
    assert estimates["link_1.inertia"] == pytest.approx(INERTIA, rel=1e-4)
    assert estimates["viscous_friction@joint_1.damping"] == pytest.approx(DAMPING, rel=1e-4)


def test_the_bench_itself_is_in_order(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, document = replayed(bench, capsys)
    assert code == 0
    assert document["warnings"] == []
    assert_right(document)


@pytest.mark.parametrize(
    ("text", "place", "found"),
    [
        (None, "run.csv", "No such file"),
        ("", "run.csv", "an empty file"),
        ("t,force_1,q_1\n", "run.csv", "no samples"),
        ("0,1,2\n1,1,2\n", "run.csv, line 1", "no header"),
        (
            "t,force_1,q1\n0,1,2\n",
            "run.csv, line 1",
            "unknown channel 'q1'; expected a channel of this system",
        ),
        ("t,tau_1,q_1\n0,1,2\n", "run.csv, line 1", "expected 'force_1', the drive of joint 1, which has no gear"),
        ("t,q_1\n0,1\n", "run.csv, header", "force_1"),
    ],
)
def test_a_capture_that_is_none(
    bench: Path, capsys: pytest.CaptureFixture[str], text: str | None, place: str, found: str
) -> None:
    (bench / "run.csv").unlink()
    if text is not None:
        (bench / "run.csv").write_text(text)
    line = refusal(bench, capsys, "replay", "run.csv", "--system", "axis.toml", "--out", "done")
    assert place in line
    assert found in line


@pytest.mark.parametrize(
    ("row", "found"),
    [
        ("3.0,1", "run.csv, line 602: 2 cells; expected 3"),
        ("3.0,one,1", "run.csv, line 602, column force_1: 'one'"),
        ("3.0,1e300,1", "run.csv, line 602, column force_1: '1e300'; expected a number of 1e+30 at most"),
        ("1e300,1,1", "run.csv, line 602, column t: '1e300'; expected a number of 1e+10 at most"),
        ("2.9,1,1", "run.csv, line 602: time 2.9 s, before that of the line above"),
    ],
)
def test_a_malformed_line_in_the_middle(bench: Path, capsys: pytest.CaptureFixture[str], row: str, found: str) -> None:
    lines = capture_lines()
    (bench / "run.csv").write_text("\n".join([*lines[:601], row, *lines[602:]]) + "\n")
    assert found in refusal(bench, capsys, "replay", "run.csv", "--system", "axis.toml", "--out", "done")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (AXIS.replace("sample_rate", "sampel_rate"), "unknown key 'sampel_rate'"),
        (AXIS[: AXIS.index("[link_1]")] + FLEXIBLE_LINK, "link_1.length: 0.0; expected a number greater than 0"),
        (AXIS.replace("viscous_friction", "vicious_friction"), "'vicious_friction'"),
        (AXIS + '[prior."link_1.inertai"]\nvalue = 1.0\nstd = 0.1\n', "'link_1.inertia'"),
        (AXIS + '[known]\n"link_1.inertai" = 1.0\n', "link_1.inertai"),
        ("name = ", "expected valid TOML"),
        (AXIS.replace("200.0", "1e308"), "sample_rate: 1e+308 Hz; expected 20480 Hz at most"),
        (AXIS.replace("200.0", "1" + 5000 * "0"), "a number of thousands of digits"),
        ("reference = " + 5000 * "[" + 5000 * "]" + AXIS, "no more than 6 levels"),
        ("reference = " + 400 * "[" + 400 * "]" + AXIS, "no more than 6 levels"),
        (AXIS + joints(399), "399 positions of joints, rotors and nodes; expected 256 at most"),
        (AXIS + elements(100000), "200002 positions of joints, rotors and nodes; expected 256 at most"),
        (None, "axis.toml: no such file or directory"),
    ],
)
def test_a_system_file_that_is_wrong(
    bench: Path, capsys: pytest.CaptureFixture[str], text: str | None, found: str
) -> None:
    (bench / "axis.toml").unlink()
    if text is not None:
        (bench / "axis.toml").write_text(text)
    assert found in refusal(bench, capsys, "replay", "run.csv", "--system", "axis.toml", "--out", "done")


@pytest.mark.parametrize("verb", [("replay", "run.csv"), ("demo",), ("markers",), ("simulate", "--capture", "new.csv")])
def test_a_system_that_is_not_shipped(bench: Path, capsys: pytest.CaptureFixture[str], verb: tuple[str, ...]) -> None:
    assert "'paper-planar'" in refusal(bench, capsys, *verb, "--system", "paper-plana")


def test_a_can_log_needs_its_dbc(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (bench / "run.log").write_text("(0.000000) can0 001#0102030405060708\n")
    line = refusal(bench, capsys, "replay", "run.log", "--system", "axis.toml", "--out", "done")
    assert "a CAN log without a DBC" in line
    source = '[[source]]\nkind = "can"\nname = "drive"\ndbc = "drive.dbc"\nsignals = { "A.B" = "q_1" }\n'
    (bench / "axis.toml").write_text(AXIS + source)
    assert "drive.dbc" in refusal(bench, capsys, "replay", "run.log", "--system", "axis.toml", "--out", "done")


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ((), "VERB"),
        (("reply", "run.csv"), "invalid choice: 'reply'"),
        (("replay", "--system", "axis.toml"), "required: CAPTURE"),
        (("replay", "run.csv"), "required: --system"),
        (("replay", "run.csv", "--sys", "axis.toml"), "--sys"),
        (
            ("replay", "run.csv", "--system", "axis.toml", "-ss", "-1"),
            "-ss: '-1'; expected a number of seconds",
        ),
        (("replay", "run.csv", "--system", "axis.toml", "-to", "later"), "-to: 'later'"),
        (("replay", "run.csv", "--system", "axis.toml", "-ss", "3", "-to", "2"), "-to: 2 s; expected a time after"),
        (("replay", "run.csv", "--system", "axis.toml", "-ss", "60"), "no samples from 60 s"),
        (("replay", "axis.toml/run.csv", "--system", "axis.toml"), "Not a directory"),
        (("replay", "run.xyz", "--system", "axis.toml"), "a name ending in .csv"),
        (("replay", "run.csv", "--system", "axis.toml", "--out", "axis.toml/x"), "axis.toml is no directory"),
        # Where permissions allow it to root, and nobody can.
        (("replay", "run.csv", "--system", "axis.toml", "--out", "/proc/run"), "nothing can be written in /proc"),
        (("simulate", "--system", "paper-planar", "--capture", "new.csv", "--duration", "0"), "greater than 0"),
        (("simulate", "--system", "paper-planar", "--capture", "new.csv", "--grade", "D"), "'D'"),
        (("simulate", "--system", "paper-planar", "--capture", "new.csv", "--seed", "-1"), "a whole number, 0 or more"),
        (("simulate", "--system", "paper-planar", "--capture", "new.txt"), "ending in .csv"),
        (("simulate", "--system", "paper-planar", "--capture", "absent/new.csv"), "No such file"),
        (("simulate", "--system", "axis.toml", "--capture", "new.csv"), "trajectory"),
        (("demo", "--system", "axis.toml"), "expected a controller and a trajectory"),
        (("bound", "--system", "axis.toml"), "expected a trajectory, or a capture"),
        (("replay", "empty", "--system", "axis.toml"), "a folder that holds neither bag nor recording"),
        (("import", "pumps", "x.mat", "--capture", "new.csv"), "'pumps'"),
        (("import", "emps", "x.mat", "--capture", "new.csv"), "No such file"),
        (
            ("import", "emps", "x.mat", "--capture", "new.csv", "--beside", "run.csv"),
            "--beside: run.csv; expected import",
        ),
        (("markers", "--system", "paper-planar", "--modes", "0"), "a whole number, 1 or more"),
    ],
)
def test_arguments_that_make_no_sense(
    bench: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], found: str
) -> None:
    assert found in refusal(bench, capsys, *arguments)


def test_a_truth_that_is_none(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth_path(bench / "run.csv").write_text("{")
    line = refusal(bench, capsys, "replay", "run.csv", "--system", "axis.toml", "--out", "done")
    assert "run.csv.truth.json" in line


def test_without_motion_the_result_says_nothing_is_determined(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    still = [f"{k / 200},0.0,0.5" for k in range(1200)]
    (bench / "run.csv").write_text("\n".join(["t,force_1,q_1", *still]) + "\n")
    code, document = replayed(bench, capsys)
    assert code == 3
    assert document["samples"] == 1200
    assert not any(p["identifiable"] for p in document["parameters"])
    assert main(["replay", "run.csv", "--system", "axis.toml", "--out", "again"]) == 3
    out, err = capsys.readouterr()
    assert out.count("not determined") == len(document["parameters"])
    assert err.splitlines() == [
        "check: force_1: never changes from 0 N m",
        "check: q_1: never changes from 0.5 rad",
    ]


def test_a_cut_last_line_is_left_out_and_named(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = capture_lines()
    (bench / "run.csv").write_text("\n".join(lines)[:-4])
    code, document = replayed(bench, capsys)
    assert code == 0
    assert document["samples"] == len(lines) - 2
    assert document["warnings"] == [f"run.csv: 1 line skipped, line {len(lines)} is cut (no newline at its end)"]
    assert_right(document)


def test_empty_and_nan_cells_are_counted_and_bridged(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = capture_lines()
    for k in (300, 500, 501):
        t, torque, _ = lines[k].split(",")
        lines[k] = f"{t},{torque},{'nan' if k == 300 else ''}"
    (bench / "run.csv").write_text("\n".join(lines) + "\n")
    code, document = replayed(bench, capsys)
    assert code == 0
    assert any(each.startswith("run.csv: 3 of 1200 cells empty or NaN in q_1, the") for each in document["warnings"])
    assert document["lost_samples"] == 0
    assert_right(document)


def test_a_long_hole_is_lost_and_begins_a_new_window(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = capture_lines()
    del lines[500:700]
    (bench / "run.csv").write_text("\n".join(lines) + "\n")
    code, document = replayed(bench, capsys)
    assert code == 0
    assert document["lost_samples"] >= 200
    assert any("too long to bridge" in warning for warning in document["warnings"])
    assert_right(document)
