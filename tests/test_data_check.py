"""Captures before they are estimated from: each thing that may be the matter is named, and nothing else."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.parse import parse_system
from sms_online.stream import Array
from sms_tools.cli import main
from sms_tools.exit_codes import BAD_INPUT
from tests.axis import AXIS, axis_block
from tests.simulations import planar_capture

SENSORS = """
[[sensor]]
channels = ["q_1"]
resolution = 1e-5
[[sensor]]
channels = ["force_1"]
"""
SYSTEM = parse_system(AXIS + SENSORS, "axis.toml")


def capture(
    q: Callable[[Array, Array], Array] = lambda t, q: q, t: Callable[[Array], Array] = lambda t: t
) -> sms.Capture:
    """The axis along two sines for 12 s with noise, its encoder's readings and its stamps as changed."""
    block = axis_block(coulomb=0.0)
    angle = q(block.t, block.values[:, 1].copy())
    return sms.Capture(t(block.t), block.channels, np.column_stack((block.values[:, 0], angle)))


def grave(data: sms.Capture, system: sms.System = SYSTEM) -> list[str]:
    found = sms.check(system, data)
    assert found.passed == (not any(remark.grave for remark in found.remarks))
    return [f"{remark.channel}: {remark.text}" for remark in found.remarks if remark.grave]


def test_a_healthy_capture_has_nothing_the_matter() -> None:
    found = sms.check(SYSTEM, capture())
    assert found.remarks == ()
    assert found.passed
    assert found.channels["q_1"].rate == pytest.approx(200.0, rel=1e-9)
    assert found.determined["link_1.inertia"] < 1.0
    assert "link_1.inertia" in found.motion()[0]


@pytest.mark.long
@pytest.mark.parametrize(("name", "grade"), [("paper-planar", "0"), ("spatial-two-link", "C")])
def test_other_simulated_sessions_have_nothing_the_matter(name: str, grade: str) -> None:
    system = sms.load_system(name)
    assert grave(sms.simulate(system, duration=2.5, grade=grade, seed=2), system) == []


def test_a_simulated_session_has_nothing_the_matter() -> None:
    assert grave(planar_capture(2.5, seed=2), sms.load_system("paper-planar")) == []


def stuck(t: Array, q: Array) -> Array:
    q[1300:1900] = q[1300]
    return q


def with_outliers(t: Array, q: Array) -> Array:
    q[[500, 1000, 1800]] += (0.7, 0.1, -0.5)
    return q


def wrapped(t: Array, q: Array) -> Array:
    return (3.0 * q + np.pi) % (2.0 * np.pi) - np.pi


def saturated(t: Array, q: Array) -> Array:
    return np.clip(q, -0.8, 0.8)


def dropped(t: Array, q: Array) -> Array:
    q[::2] = np.nan
    return q


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (stuck, "q_1: stuck at "),
        (with_outliers, "q_1: 3 outliers left out, the first at 2.500 s"),
        (wrapped, "q_1: wraps, "),
        (saturated, "q_1: saturated at "),
        (dropped, "q_1: 100 Hz, described as 200 Hz"),
        (lambda t, q: np.round(q, 3), "q_1: steps of 0.001 rad, described as 1e-05"),
        (lambda t, q: np.full_like(q, 0.25), "q_1: never changes from 0.25 rad"),
        (lambda t, q: np.full_like(q, np.nan), "q_1: no sample"),
    ],
)
def test_what_is_the_matter_with_a_channel_is_named(change: Callable[[Array, Array], Array], said: str) -> None:
    found = grave(capture(change))
    assert any(line.startswith(said) for line in found), found
    assert not any(line.startswith("force_1") for line in found)


def test_times_in_milliseconds_are_recognised() -> None:
    found = grave(capture(t=lambda t: 1000.0 * t))
    assert "q_1: time in ms, not in s: a sample every 5" in found


def test_a_replay_of_times_in_milliseconds_ends_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "axis.toml").write_text(AXIS + SENSORS)
    run = sms.write_capture(capture(t=lambda t: 1000.0 * t), tmp_path / "run.csv")
    out = tmp_path / "out"
    assert main(["replay", str(run), "--system", str(tmp_path / "axis.toml"), "--out", str(out)]) == BAD_INPUT
    said = capsys.readouterr().err
    assert f'{run.name}, t: stamps in ms; expected s, or stamp_unit = "ms"' in said


@pytest.mark.slow
def test_times_are_recognised_without_described_sensors() -> None:
    found = grave(capture(t=lambda t: 1000.0 * t), parse_system(AXIS, "axis.toml"))
    assert ": time in ms, not in s: a sample every 5" in found
    # Slower than the system, as a camera is, and no other unit.
    assert not grave(capture(t=lambda t: 4.0 * t), parse_system(AXIS, "axis.toml"))


def test_holes_are_counted_and_placed() -> None:
    found = sms.check(SYSTEM, capture(t=lambda t: t + 0.5 * (t > 3.0) + 0.2 * (t > 7.0)))
    assert "2 holes of more than 5 samples, the first at 3.000 s, the longest of 0.505 s" in found.lines[0]
    assert found.passed


def test_a_coarse_encoder_that_is_described_so_is_fine() -> None:
    coarse = parse_system(AXIS + SENSORS.replace("1e-5", "1e-3"), "axis.toml")
    assert grave(capture(lambda t, q: np.round(q, 3)), coarse) == []


def test_a_channel_that_nobody_reads_is_named() -> None:
    planar = sms.load_system("paper-planar")
    data = planar_capture(1.0)
    gyro = sms.Capture(
        data.t, (*data.channels, "gyro_0_z"), np.column_stack((data.values, np.cumsum(data.values[:, 0])))
    )
    remarks = sms.check(planar, gyro).remarks
    assert [(remark.channel, remark.text, remark.grave) for remark in remarks] == [
        ("gyro_0_z", "nobody reads it", False)
    ]


def test_a_capture_without_motion_determines_nothing() -> None:
    rng = np.random.default_rng(5)
    data = sms.Capture(np.arange(2400) / 200.0, ("force_1", "q_1"), 1e-4 * rng.standard_normal((2400, 2)))
    assert ": the motion determines no parameter" in grave(data)


@pytest.mark.slow
def test_the_page_and_its_exit_codes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "axis.toml").write_text(AXIS + SENSORS)
    sms.write_capture(capture(), tmp_path / "good.csv")
    sms.write_capture(capture(stuck), tmp_path / "bad.csv")
    arguments = ["--system", str(tmp_path / "axis.toml"), "--out", str(tmp_path / "out")]
    assert main(["check", str(tmp_path / "good.csv"), *arguments]) == 0
    assert "fit to be estimated from" in capsys.readouterr().out
    assert main(["check", str(tmp_path / "bad.csv"), *arguments]) == 1
    assert "q_1: stuck at" in capsys.readouterr().out
    document = json.loads((tmp_path / "out" / "check.json").read_text())
    assert (document["schema"], document["passed"]) == ("sms-online/check/1", False)


@pytest.mark.slow
def test_a_replay_begins_with_what_is_the_matter(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "axis.toml").write_text(AXIS + SENSORS)
    sms.write_capture(capture(stuck), tmp_path / "run.csv")
    arguments = ["replay", str(tmp_path / "run.csv"), "--system", str(tmp_path / "axis.toml"), "--out", str(tmp_path)]
    assert main(arguments) == 0
    assert "check: q_1: stuck at" in capsys.readouterr().err
    results = json.loads((tmp_path / "results.json").read_text())
    # What the stuck encoder did to its last windows has ended: the estimate of before holds.
    assert [event["kind"] for event in results["events"]] == ["transient"]
    warnings = results["warnings"]
    assert any(warning.startswith("q_1: stuck at") for warning in warnings)


@pytest.mark.slow
def test_the_check_and_the_estimate_count_the_same_outliers() -> None:
    data = capture(with_outliers)
    found, result = sms.check(SYSTEM, data), sms.estimate(SYSTEM, data)
    assert result.outliers == {"q_1": 3}
    assert "q_1: 3 outliers left out" in result.warnings
    assert "q_1: 3 outliers left out, the first at 2.500 s" in found.lines


@pytest.mark.slow
def test_a_few_outliers_are_no_reason_to_refuse() -> None:
    block = axis_block(coulomb=0.0)
    values = block.values.copy()
    values[700, 1] += 0.3
    values[900, 0] += 300.0
    found = sms.check(SYSTEM, sms.Capture(block.t, block.channels, values))
    assert found.passed
    assert "force_1: 1 outliers, the first at 4.500 s" in found.lines
    assert "q_1: 1 outliers left out, the first at 3.500 s" in found.lines
