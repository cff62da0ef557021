"""The history of a session: what each tracker has estimated on the way, in bounded memory, and where it is written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import sms_online as sms
from sms_online import history as history_module
from sms_online.history import FIRST_INTERVAL
from sms_online.stream import Block
from sms_tools.cli import main
from sms_tools.html_report.moved import moved_charts
from tests.axis import AXIS, axis_block, capture_lines

TRACKERS = ("rls:forgetting=window,memory=2", "rls")


@pytest.fixture(scope="module")
def block() -> Block:
    """Twelve seconds of the axis, which its description explains."""
    return axis_block(coulomb=0.0)


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> sms.System:
    path = tmp_path_factory.mktemp("axis") / "axis.toml"
    path.write_text(AXIS, encoding="utf-8")
    return sms.load_system(path)


@pytest.fixture(scope="module")
def result(system: sms.System, block: Block) -> sms.Result:
    return estimated(system, block, 2400)


def estimated(system: sms.System, block: Block, rows: int, resumed_at: float = np.inf) -> sms.Result:
    session = sms.Session(system, block.channels, tracker=TRACKERS)
    for piece in block.pieces(rows):
        if piece.t[0] > resumed_at:
            session, resumed_at = sms.Session.restore(session.save()), np.inf
        session.update(piece)
    session.finish()
    return session.result


def test_each_tracker_has_a_history_the_judged_one_first(result: sms.Result) -> None:
    assert [(each.tracker, each.judged) for each in result.history] == [("rls window 2 s", True), ("rls", False)]
    for each in result.history:
        assert each.parameters == tuple(result.parameters)
        assert each.t.size == pytest.approx(12.0 / FIRST_INTERVAL, abs=3)
        assert each.covariance.shape == (each.t.size, 2, 2)


def test_a_history_ends_with_the_result(result: sms.Result) -> None:
    last = result.history[0]
    assert last.estimate[-1].tolist() == [p.value for p in result.parameters.values()]
    np.testing.assert_allclose(last.std[-1], [p.std for p in result.parameters.values()], rtol=1e-12)
    beside = result.trackers[1].parameters.values()
    assert result.history[1].estimate[-1].tolist() == [p.value for p in beside]


def test_a_covariance_is_symmetric_and_correlated(result: sms.Result) -> None:
    covariance = result.history[0].covariance[-1]
    assert covariance[0, 1] == covariance[1, 0] != 0.0
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_all_that_is_known_forgets_less_than_a_window(result: sms.Result) -> None:
    window, whole = (each.std[-1] for each in result.history)
    assert (window > 1.5 * whole).all()


@pytest.mark.parametrize(("rows", "resumed_at"), [(37, np.inf), (200, 5.0)])
def test_cuts_and_checkpoints_leave_no_trace(
    rows: int, resumed_at: float, system: sms.System, block: Block, result: sms.Result
) -> None:
    for here, there in zip(estimated(system, block, rows, resumed_at).history, result.history, strict=True):
        np.testing.assert_array_equal(here.t, there.t)
        np.testing.assert_array_equal(here.estimate, there.estimate)
        np.testing.assert_array_equal(here.upper, there.upper)


@pytest.mark.slow
def test_a_long_session_keeps_a_bounded_number_of_instants(
    system: sms.System, block: Block, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history_module, "MOST_INSTANTS", 8)
    (whole, _) = estimated(system, block, 200).history
    assert 4 <= whole.t.size <= 9
    steps = np.diff(whole.t)
    assert steps[:-1].min() > 3.0 * FIRST_INTERVAL
    assert whole.t[-1] == block.t[-1]


@pytest.mark.slow
def test_more_parameters_keep_fewer_instants(system: sms.System, block: Block, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two trackers of two parameters are ten numbers an instant."""
    monkeypatch.setattr(history_module, "MOST_NUMBERS", 100)
    assert estimated(system, block, 200).history[0].t.size <= 11


def test_a_frame_has_each_pair_of_parameters_once(result: sms.Result) -> None:
    frame = result.history[0].to_frame()
    inertia, damping = result.parameters
    assert list(frame.columns) == [inertia, f"{inertia}.std", damping, f"{damping}.std", f"{inertia}~{damping}"]
    np.testing.assert_array_equal(frame[f"{inertia}~{damping}"], result.history[0].covariance[:, 0, 1])


def test_results_json_is_thinned_and_keeps_the_last(result: sms.Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history_module, "MOST_WRITTEN", 10)
    document = result.document()["history"]
    assert [each["tracker"] for each in document] == ["rls window 2 s", "rls"]
    assert len(document[0]["t"]) <= 10
    assert document[0]["t"][-1] == 2399 / 200.0
    last = [p["estimate"][-1] for p in document[0]["parameters"]]
    assert last == [p.value for p in result.parameters.values()]


def test_replay_writes_the_history_beside_the_results(tmp_path: Path) -> None:
    (tmp_path / "axis.toml").write_text(AXIS, encoding="utf-8")
    (tmp_path / "run.csv").write_text("\n".join(capture_lines()), encoding="utf-8")
    options = ["--system", str(tmp_path / "axis.toml"), "--out", str(tmp_path / "out"), "--rerun", "off"]
    assert main(["replay", str(tmp_path / "run.csv"), *options, "--tracker", TRACKERS[0], "--tracker", "rls"]) == 0
    document = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))
    table = pq.read_table(tmp_path / "out" / "history.parquet")
    assert table["tracker"].unique().to_pylist() == ["rls window 2 s", "rls"]
    assert table.schema.field("link_1.inertia").metadata[b"unit"] == "kg m²".encode()
    rls = table.filter([each == "rls" for each in table["tracker"].to_pylist()])
    assert rls["t"].to_pylist() == document["history"][1]["t"]
    written = document["history"][1]["parameters"][0]
    assert rls["link_1.inertia"].to_pylist() == written["estimate"]
    assert rls["link_1.inertia.std"].to_pylist() == written["std"]


def history_of(values: list[float], std: float, judged: bool) -> dict[str, object]:
    name = "rls" if judged else "kalman"
    parameters = [{"name": "k", "estimate": values, "std": [std] * len(values)}]
    return {"tracker": name, "judged": judged, "t": list(map(float, range(len(values)))), "parameters": parameters}


@pytest.mark.parametrize(("last", "moves"), [(1.2, False), (2.0, True)])
def test_the_report_plots_what_has_moved(last: float, moves: bool) -> None:
    """Two estimates of standard deviation 0.1, independent: 0.2 apart they may be the same, 1.0 apart not."""
    values = [1.0] * 10 + [last] * 10
    histories = [history_of(values, 0.1, True), history_of([1.0] * 20, 0.1, False)]
    parameter = {"name": "k", "unit": "N m/rad"}
    document = {"history": histories, "trackers": [], "parameters": [parameter], "events": []}
    charts = moved_charts(document)
    assert len(charts) == moves
    if moves:
        assert charts[0].caption == "k ± 2σ, N m/rad"
        assert [(label, color) for label, color, _ in charts[0].key] == [("rls, judged", "blue"), ("kalman", "orange")]


def test_what_another_tracker_makes_of_a_parameter_is_no_move() -> None:
    """Least squares of all rows wanders where another parameter drifts."""
    histories = [history_of([1.0] * 20, 0.1, True), history_of([1.0] * 10 + [2.0] * 10, 0.1, False)]
    document = {"history": histories, "trackers": [], "parameters": [{"name": "k", "unit": ""}], "events": []}
    assert not moved_charts(document)


def test_the_report_plots_a_drift_that_was_found() -> None:
    drift = {"parameter": "k"}
    document = {
        "history": [history_of([1.0, 1.0, 1.01], 0.1, True)],
        "trackers": [{"drifts": [drift]}],
        "parameters": [{"name": "k", "unit": ""}],
        "events": [],
    }
    (chart,) = moved_charts(document)
    assert chart.caption == "k ± 2σ"
