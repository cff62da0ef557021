"""A session that is watched: the same bits, a recording that says what the results say, and no viewer that stops it."""

from __future__ import annotations

import json
import resource
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import numpy as np
import pytest
from rerun.blueprint import Corner2D

from sms_adapters.capture import CaptureWriter
from sms_adapters.system_file import load_system
from sms_adapters.truth import write_truth
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.snapshot import statistics_of
from sms_online.stream import Block
from sms_sim.sensors import Sensors
from sms_sim.simulate import Simulation, sampled_blocks
from sms_tools.cli import main
from sms_tools.view.blueprint import _Plots
from sms_tools.view.session import open_view, references
from tests.evaluated import elsewhere, results_document
from tests.recordings import columns, scalars
from tests.sessions_of import session_of

# Of the example's motion: enough for its first weights, every marker moving, and a recording of a few batches' size.
SECONDS = 8.0
DISPLAY_RATE = 20.0  # pictures/s


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory, planar_session: Simulation) -> Path:
    """The paper's example with noise of grade B, seed 1, and its truth beside it."""
    path = tmp_path_factory.mktemp("view") / "run.csv"
    plant = planar_session.plant
    with CaptureWriter(path, Sensors(plant.system, plant.channels, "B", 1).channels) as writer:
        for block in sampled_blocks(planar_session, "B", seed=1):
            kept = block.t <= SECONDS
            writer.write(Block(block.t[kept], block.channels, block.values[kept]))
    write_truth(path, {p.name: p.nominal for p in plant.model.parameters}, {})
    return path


@pytest.fixture(scope="module")
def samples(planar_block: Block) -> Block:
    """The same part of the motion, noise-free and at hand."""
    kept = planar_block.t <= SECONDS
    return Block(planar_block.t[kept], planar_block.channels, planar_block.values[kept])


@pytest.fixture(scope="module")
def recorded(capture: Path) -> Path:
    """The directory of a replay with a recording."""
    out = capture.parent / "recorded"
    arguments = ["replay", str(capture), "--system", "paper-planar", "--out", str(out), "--rerun", "save"]
    assert main(arguments) == 0
    return out


def results(directory: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((directory / "results.json").read_text())
    return found


@pytest.mark.slow
def test_the_recordings_last_values_are_the_results(recorded: Path) -> None:
    found = {p["symbol"]: p for p in results(recorded)["parameters"]}
    seen = set()
    for kind in ("spacecraft", "motors", "links", "joints"):
        entity = f"/parameters/{kind}/estimate"
        names = columns(recorded / "session.rrd", entity)[0]["SeriesLines:names"]
        _, estimates = scalars(recorded / "session.rrd", entity)
        _, deviations = scalars(recorded / "session.rrd", f"/parameters/{kind}/std")
        for name, estimate, std in zip(names, estimates[-1], deviations[-1], strict=True):
            assert estimate == found[name]["estimate"]
            assert std == (np.inf if found[name]["std"] is None else found[name]["std"])
            seen.add(name)
    assert seen == set(found)


@pytest.mark.slow
def test_the_recordings_timeline_is_complete(recorded: Path) -> None:
    rows = columns(recorded / "session.rrd", "/arm/tip")
    t = np.array([row["time"].total_seconds() for row in rows if row.get("Points3D:positions") is not None])
    np.testing.assert_allclose(t, np.arange(round(SECONDS * DISPLAY_RATE) + 1) / DISPLAY_RATE, rtol=0, atol=1.1e-3)
    t, _ = scalars(recorded / "session.rrd", "/parameters/links/estimate")
    assert np.diff(t).max() <= 0.5
    assert t[-1] == pytest.approx(SECONDS)


@pytest.mark.slow
def test_rerun_verifies_the_recording(recorded: Path) -> None:
    rerun = Path(sys.executable).with_name("rerun")
    done = subprocess.run(
        [str(rerun), "rrd", "verify", str(recorded / "session.rrd")], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_events_are_logged_when_they_happen(recorded: Path) -> None:
    rows = [row for row in columns(recorded / "session.rrd", "/log") if row.get("TextLog:text")]
    lines = [row["TextLog:text"][0].split(" s: ")[1] for row in rows]
    named = {line.split(" is ")[0] for line in lines if "is determined" in line}
    assert named >= {p["name"] for p in results(recorded)["parameters"] if p["identifiable"]}


@pytest.mark.long
def test_watching_changes_no_bit(recorded: Path, capture: Path, tmp_path: Path) -> None:
    main(["replay", str(capture), "--system", "paper-planar", "--out", str(tmp_path)])
    unseen, seen = results(tmp_path), results(recorded)
    assert unseen["parameters"] == seen["parameters"]
    assert unseen["residual"] == seen["residual"]


@pytest.mark.long
def test_statistics_stay_those_of_when_they_were_taken(samples: Block) -> None:
    system = load_system("paper-planar")
    estimator = Estimator(system, samples.channels, "test")
    half = samples.t.size // 2
    estimator.push(Block(samples.t[:half], samples.channels, samples.values[:half]))
    taken = statistics_of(estimator)
    then = results_document(estimator, 0.0, [])
    estimator.push(Block(samples.t[half:], samples.channels, samples.values[half:]))
    assert elsewhere(taken) == then
    assert results_document(estimator, 0.0, []) != then


@pytest.mark.long
def test_health_of_a_live_source_is_recorded(samples: Block, tmp_path: Path) -> None:
    estimator = Estimator(load_system("paper-planar"), samples.channels, "test")
    health = {"latency": {"p99": 12.5}, "clocks": {"can": -0.25}}
    with open_view("save", estimator, samples.channels, tmp_path, patient=True, health=lambda: health) as view:
        for block in view.watch([samples]):
            estimator.push(block)
    for entity, value in (("/health/latency/p99", 12.5), ("/health/clocks/can", -0.25)):
        t, values = scalars(tmp_path / "session.rrd", entity)
        assert t[-1] > SECONDS - 1.0
        assert np.unique(values).tolist() == [value]


@pytest.fixture
def deaf_viewer() -> Iterator[int]:
    """The port of somebody who accepts connections and never reads."""
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        yield int(listening.getsockname()[1])


@pytest.mark.realtime
def test_an_absent_viewer_is_named_and_the_session_goes_on(capture: Path, tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # nobody listens there
        choice = f"connect=127.0.0.1:{taken.getsockname()[1]}"
        code = main(
            ["replay", str(capture), "--system", "paper-planar", "--out", str(tmp_path), "--rerun", choice, "-to", "5"]
        )
    assert code == 0
    assert any("no viewer at" in warning for warning in results(tmp_path)["warnings"])


@pytest.mark.realtime
def test_a_viewer_that_never_reads_is_given_up(
    deaf_viewer: int, samples: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sms_tools.view.session.CLOSING", 1.0)
    estimator = Estimator(load_system("paper-planar"), samples.channels, "test")
    with open_view(f"connect=127.0.0.1:{deaf_viewer}", estimator, samples.channels, tmp_path) as view:
        for block in view.watch([samples]):
            estimator.push(block)
        estimator.finish()
    assert view.status
    assert view.warnings
    alone = session_of(load_system("paper-planar"), [samples])
    np.testing.assert_array_equal(estimator.estimate().pi, alone.estimate().pi)


@pytest.mark.realtime
def test_a_full_disk_ends_the_recording_alone(capture: Path, tmp_path: Path) -> None:
    largest = 300_000  # bytes of any file; the recording needs twice as many

    def small_disk() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))

    arguments = ["replay", str(capture), "--system", "paper-planar", "--out", str(tmp_path), "--rerun", "save"]
    done = subprocess.run(
        [sys.executable, "-m", "sms_tools", *arguments],
        preexec_fn=small_disk,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert "cannot be written any further" in done.stderr
    assert any("cannot be written any further" in warning for warning in results(tmp_path)["warnings"])


@pytest.mark.realtime
def test_a_view_that_dies_is_named(samples: Block, tmp_path: Path) -> None:
    estimator = Estimator(load_system("paper-planar"), samples.channels, "test")
    with open_view("save", estimator, samples.channels, tmp_path) as view:
        assert view._process is not None
        view._process.kill()
        for block in view.watch([samples]):
            estimator.push(block)
        estimator.finish()
    assert "its process ended" in view.status


@pytest.mark.realtime
def test_a_killed_session_leaves_a_whole_recording(capture: Path, tmp_path: Path) -> None:
    arguments = ["replay", str(capture), "--system", "paper-planar", "--out", str(tmp_path), "--rerun", "save"]
    session = subprocess.Popen(
        [sys.executable, "-m", "sms_tools", *arguments, "--speed", "1"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert session.stderr is not None
    session.stderr.readline()  # the view is open
    sleep(1.0)
    session.kill()
    session.wait()
    rerun = [str(Path(sys.executable).with_name("rerun")), "rrd", "verify", str(tmp_path / "session.rrd")]
    end = monotonic() + 20.0
    while subprocess.run(rerun, capture_output=True, timeout=60).returncode != 0:
        assert monotonic() < end, "the recording is never completed"
        sleep(0.2)
    assert columns(tmp_path / "session.rrd", "/arm/tip")


def test_references_are_the_truth_or_else_nominal_values() -> None:
    estimator = Estimator(load_system("paper-planar"), _channels(), "test")
    nominal = references(estimator, None)
    assert all(reference is not None and not reference.is_true for reference in nominal)
    truth = {p.name: 2.0 * p.nominal for p in estimator.base.physical}
    for known, p in zip(references(estimator, truth), estimator.base.parameters, strict=True):
        assert known is not None
        assert known.is_true
        assert known.value == pytest.approx(2.0 * p.nominal)


def test_a_parameter_without_a_nominal_value_has_no_reference() -> None:
    system = load_system("quanser-2dsfl")
    base = find_base_parameters(build_model(system))
    channels = ("tau_1", "tau_2", "theta_m_1", "theta_m_2", "q_1", "q_2")
    found = references(Estimator(system, channels, "test"), None)
    assert [reference is None for reference in found] == [p.nominal == 0.0 for p in base.parameters]
    assert None in found


def _channels() -> tuple[str, ...]:
    layout = build_model(load_system("paper-planar")).layout
    return (*layout.position_names, "tau_1", "tau_2")


def test_a_legend_is_over_time_to_come() -> None:
    plot = _Plots(begin=None)._plot("a plot", ["a/**"])
    legend, axis = plot.properties["PlotLegend"], plot.properties["TimeAxis"]
    assert legend.corner.as_arrow_array().to_pylist() == [Corner2D.RightTop.value]
    (shown,) = axis.view_range.as_arrow_array().to_pylist()
    # A plot of a screen of 1400 pixels has 380 beside its axis, the longest legend 120 of them.
    assert shown["end"] > 0.25 * (shown["end"] - shown["start"])
