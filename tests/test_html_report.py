"""report.html: self-contained, well-formed, and saying what the results say."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from evaluated import results_document
from sms_tools.html_report.error_bars import Bar, error_bars
from sms_tools.html_report.svg import Axis, Series, chart

from sms_adapters.capture import CaptureWriter
from sms_adapters.system_file import load_system
from sms_online.effects.build import build_model
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array, Block
from sms_sim.simulate import Simulation
from sms_tools.cli import main
from sms_tools.html_report import history as history_module
from sms_tools.html_report import svg
from sms_tools.html_report.arm_drawing import arm_drawings
from sms_tools.html_report.history import History
from sms_tools.html_report.page import write_report
from sms_tools.html_report.paper_example import figure_6
from sms_tools.view.scene import Scene
from sms_tools.view.session import references

SVG = "{http://www.w3.org/2000/svg}"


def watched(block: Block) -> tuple[Estimator, History]:
    """The planar example, estimated and remembered."""
    estimator = Estimator(load_system("paper-planar"), block.channels, "test")
    history = History(estimator, block.channels)
    for piece in history.watch([block]):
        estimator.push(piece)
    estimator.finish()
    history.finish()
    return estimator, history


@pytest.fixture(scope="module")
def page(planar_block: Block, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The report of the planar example."""
    estimator, history = watched(planar_block)
    truth = {p.name: p.nominal for p in estimator.base.physical}
    document = results_document(estimator, 1000.0, ["a warning with <angle brackets>"], truth)
    directory = tmp_path_factory.mktemp("report")
    return write_report(directory, document, estimator, history, references(estimator, truth)).read_text()


def test_nothing_is_fetched_from_elsewhere(page: str) -> None:
    assert not re.search(r"(src|href)=|https?://|@import|<script", page)


def test_every_drawing_is_well_formed(page: str) -> None:
    drawings = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert len(drawings) >= 10
    for drawing in drawings:
        ElementTree.fromstring(drawing)
    names = re.findall(r'clipPath id="(\w+)"', page)
    assert len(names) == len(set(names))


def test_every_parameter_and_warning_is_told(page: str, planar_block: Block) -> None:
    estimator = Estimator(load_system("paper-planar"), planar_block.channels, "test")
    for p in estimator.base.parameters:
        assert html.escape(p.name) in page
    assert "a warning with &lt;angle brackets&gt;" in page


def test_the_same_session_gives_the_same_page(page: str, planar_block: Block, tmp_path: Path) -> None:
    estimator, history = watched(planar_block)
    truth = {p.name: p.nominal for p in estimator.base.physical}
    document = results_document(estimator, 1000.0, ["a warning with <angle brackets>"], truth)
    again = write_report(tmp_path, document, estimator, history, references(estimator, truth)).read_text()
    assert again == page


def test_the_history_ends_with_the_results(planar_block: Block) -> None:
    estimator, history = watched(planar_block)
    last = history.instants[-1]
    np.testing.assert_array_equal(last.estimate, estimator.estimate().pi)
    assert last.t == planar_block.t[-1]
    assert np.all(np.diff([instant.t for instant in history.instants]) > 0)


def test_remembering_changes_no_bit(planar_block: Block) -> None:
    estimator, _ = watched(planar_block)
    alone = Estimator(load_system("paper-planar"), planar_block.channels, "test")
    alone.push(planar_block)
    alone.finish()
    np.testing.assert_array_equal(estimator.estimate().pi, alone.estimate().pi)


def test_a_long_session_is_thinned_evenly(planar_block: Block, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history_module, "MOST_INSTANTS", 20)
    _, history = watched(planar_block)
    assert 10 <= len(history.instants) <= 21
    # All but the last step, which ends with the session.
    steps = np.diff([instant.t for instant in history.instants])[:-1]
    assert steps.max() <= 1.5 * steps.min()


def test_replay_writes_it_beside_the_results(tmp_path: Path, planar_block: Block) -> None:
    capture = tmp_path / "run.csv"
    with CaptureWriter(capture, planar_block.channels) as writer:
        writer.write(Block(planar_block.t[:6000], planar_block.channels, planar_block.values[:6000]))
    assert main(["replay", str(capture), "--system", "paper-planar", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "results.json").read_text())
    assert found["system"]["title"] in (tmp_path / "report.html").read_text()


def polylines(text: str) -> list[Array]:
    root = ElementTree.fromstring(text.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" '))
    return [
        np.array([point.split(",") for point in line.attrib["points"].split()], dtype=float)
        for line in root.iter(f"{SVG}polyline")
    ]


def test_a_gap_interrupts_a_line() -> None:
    y = np.array([0.0, 1.0, np.nan, 1.0, 2.0, 3.0])
    assert [len(line) for line in polylines(chart("c", np.arange(6.0), [Series("a", y)], "x"))] == [2, 3]


def test_a_line_stands_where_its_axis_says() -> None:
    (line,) = polylines(chart("c", np.array([0.0, 10.0]), [Series("a", np.array([0.0, 4.0]))], "x", (0.0, 4.0)))
    assert line[0].tolist() == [svg.LEFT, svg.HEIGHT - svg.BOTTOM]
    assert line[1].tolist() == [svg.WIDTH - svg.RIGHT, svg.TOP]


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-20.0, 20.0), (3e-6, 4e-6), (-7.0, 1234.0)])
def test_ticks_are_round_and_inside(low: float, high: float) -> None:
    ticks = Axis(low, high, 0.0, 100.0).ticks()
    assert 3 <= len(ticks) <= 7
    assert all(low - 1e-9 * (high - low) <= tick <= high + 1e-9 * (high - low) for tick in ticks)
    steps = np.diff(ticks)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
    mantissa = steps[0] / 10.0 ** np.floor(np.log10(steps[0]) + 1e-9)
    assert min(abs(mantissa - m) for m in (1.0, 2.0, 5.0)) < 1e-6


@pytest.mark.parametrize("name", ["paper-planar", "seven-joint", "emps"])
def test_any_arm_can_be_drawn(name: str) -> None:
    scene = Scene(build_model(load_system(name)))
    x = np.zeros((3, scene.model.layout.n_x))
    if name == "seven-joint":
        x[:, 6] = 1.0
    for figure in arm_drawings(scene, x, [0, 2], ["a", "b"]):
        ElementTree.fromstring(figure)


def test_figure_6_shows_angles_rates_and_torques(planar_session: Simulation) -> None:
    drawings = re.findall(r"<svg.*?</svg>", figure_6(planar_session), re.DOTALL)
    assert [len(polylines(drawing)) for drawing in drawings] == [4, 4, 2]


def test_a_bar_that_goes_on_beyond_its_scale_says_so() -> None:
    inside, right, both = (error_bars([Bar(*bar, "#000")], 1.0) for bar in ((0.0, 0.9), (0.5, 0.9), (0.0, 3.0)))
    assert [drawing.count("<path") for drawing in (inside, right, both)] == [0, 1, 2]


def test_the_judgement_is_the_first_thing_on_the_page(page: str) -> None:
    assert page.index('class="judgement trust"') < page.index("<h1>")
    assert "Trust: 16 of 16 parameters determined" in page
