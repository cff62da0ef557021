"""A session in which something changes, as people see it: plots, table, log and page go on with the new parameters."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from sms_adapters.capture import CaptureWriter
from sms_online.description.parse import parse_system
from sms_online.pipeline.snapshot import statistics_of
from sms_online.stream import Block
from sms_tools.cli import main
from tests.axis import AXIS, DAMPING, INERTIA
from tests.evaluated import elsewhere, results_document
from tests.recordings import scalars
from tests.sessions_of import session_of

RATE, CHANGE, SECONDS = 200.0, 10.0, 20.0
SYSTEM = parse_system(AXIS, "axis.toml")


@pytest.fixture(scope="module")
def session() -> Block:
    """An axis that takes hold of a tenth of its inertia more at CHANGE; seed 5."""
    t = np.arange(round(SECONDS * RATE)) / RATE
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    rate, acceleration = 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t), -4 * np.sin(2 * t) - 7.5 * np.sin(5 * t)
    torque = np.where(t > CHANGE, 1.1, 1.0) * INERTIA * acceleration + DAMPING * rate
    noise = np.random.default_rng(5).standard_normal((t.size, 2)) * [0.05, 1e-4]
    return Block(t, ("force_1", "q_1"), np.stack((torque, q), axis=1) + noise)


@pytest.fixture(scope="module")
def shown(session: Block, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of its replay with a recording."""
    folder = tmp_path_factory.mktemp("changed")
    (folder / "axis.toml").write_text(AXIS)
    with CaptureWriter(folder / "run.csv", session.channels) as writer:
        writer.write(session)
    arguments = ["replay", str(folder / "run.csv"), "--system", str(folder / "axis.toml"), "--out", str(folder)]
    assert main([*arguments, "--rerun", "save"]) == 0
    return folder


@pytest.mark.long
def test_pickled_statistics_say_the_same_after_an_event(session: Block) -> None:
    estimator = session_of(SYSTEM, [session])
    assert estimator.base.n == 3
    assert elsewhere(statistics_of(estimator)) == results_document(estimator, 0.0, [])


@pytest.mark.slow
def test_a_parameter_that_an_event_has_added_is_recorded(shown: Path) -> None:
    results = json.loads((shown / "results.json").read_text())
    assert not any("view" in warning for warning in results["warnings"])
    found = {p["name"]: p["estimate"] for p in results["parameters"]}
    assert "payload.inertia" in found
    last: dict[str, float] = {}
    lines: list[str] = []
    for chunk in RrdReader(str(shown / "session.rrd")).stream():
        for row in chunk.to_record_batch().to_pylist():
            if chunk.entity_path.endswith("/estimate") and row.get("Scalars:scalars"):
                last[chunk.entity_path] = row["Scalars:scalars"][0]
            lines += row.get("TextLog:text") or []
    (payload,) = (value for path, value in last.items() if path.startswith("/parameters/payload"))
    assert payload == found["payload.inertia"]
    assert any(re.search(r"s: event at 10\.0\d+ s: payload payload.inertia", text) for text in lines)


@pytest.mark.slow
def test_an_event_is_marked_in_every_plot(shown: Path) -> None:
    """Of each group of parameters in its last drawing, that of the parameter which the event has added too."""
    (event,) = json.loads((shown / "results.json").read_text())["events"]
    drawings: dict[str, list[str]] = {}
    for entity in {chunk.entity_path for chunk in RrdReader(str(shown / "session.rrd")).stream()}:
        if entity.startswith("/parameters") and entity.endswith("/deviation"):
            group, drawing, _ = entity.removeprefix("/parameters/").split("/")
            drawings.setdefault(group, []).append(drawing)
    assert {"links", "payload"} <= drawings.keys()
    last = {group: max(found, key=lambda name: int(name.rpartition("_")[2])) for group, found in drawings.items()}
    parameters = [f"/parameters/{group}/{drawing}/events" for group, drawing in last.items()]
    for entity in (*parameters, "/residual/relative_events", "/residual/whitened_events"):
        t, values = scalars(shown / "session.rrd", entity)
        at = t[np.isfinite(values[:, 0])]
        assert event["time"] == pytest.approx(at[0], abs=1e-6), entity


@pytest.mark.slow
def test_the_last_drawing_holds_what_was_before_the_event(shown: Path) -> None:
    entities = {chunk.entity_path for chunk in RrdReader(str(shown / "session.rrd")).stream()}
    drawn = [e for e in entities if e.startswith("/parameters/links/") and e.endswith("/deviation")]
    last = max(drawn, key=lambda e: [int(number) for number in re.findall(r"\d+", e)])
    t, values = scalars(shown / "session.rrd", last)
    assert t[0] < CHANGE < t[-1]
    # About the last estimate.
    np.testing.assert_allclose(values[-1], 0.0, atol=1e-9)


@pytest.mark.slow
def test_the_page_draws_all_parameters_of_a_changed_session(shown: Path) -> None:
    page = (shown / "report.html").read_text()
    assert "payload: from the last estimate ± 2σ" in page
    assert "event at" in page
