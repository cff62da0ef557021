"""report.html: self-contained, well-formed, readable at any width, and saying what the results say."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from sms_adapters.capture import CaptureWriter
from sms_adapters.system_file import load_system
from sms_online.effects.build import build_model
from sms_online.history import MOST_WRITTEN, History
from sms_online.model.layout import Layout
from sms_online.pipeline.estimator import Estimator
from sms_online.session import Session
from sms_online.stream import Block
from sms_sim.simulate import Simulation
from sms_tools.cli import main
from sms_tools.html_report import course as course_module
from sms_tools.html_report.arm_drawing import arm_drawings
from sms_tools.html_report.course import MOST_INSTANTS, Course, CourseRecorder
from sms_tools.html_report.figures import PALETTE, Series, chart
from sms_tools.html_report.page import _convergence, _residual, write_report
from sms_tools.html_report.paper_example import figure_6
from sms_tools.html_report.parameter_rows import error_bar
from sms_tools.view.scene import Scene
from tests.axis import AXIS, axis_block
from tests.evaluated import results_document
from tests.test_view_scene import rigid_axis

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
WARNING = "a warning with <angle brackets>"
# Bytes of a page, at most.
LARGEST = 2_000_000


def watched(block: Block) -> tuple[Session, Course]:
    """The planar example, estimated, and what was seen of it."""
    session = Session(load_system("paper-planar"), block.channels)
    recorder = CourseRecorder(session)
    for piece in recorder.watch([block]):
        session.update(piece)
    session.finish()
    return session, recorder.course


def report_of(session: Session, course: Course, directory: Path, throughput: float = 1000.0) -> str:
    truth = {"parameters": session.system.nominal}
    result = session.evaluate(truth, warnings=[WARNING], throughput=throughput)
    nominal = {p.name: p.nominal for p in session.estimator.base.parameters if p.nominal}
    return write_report(directory, result.document(), course, nominal, Scene(session.estimator.model)).read_text()


@pytest.fixture(scope="module")
def planar_block(planar_block: Block) -> Block:
    """The first eight seconds, in which all parameters are determined."""
    return next(iter(planar_block.pieces(8001)))


@pytest.fixture(scope="module")
def page(planar_block: Block, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The report of the planar example."""
    return report_of(*watched(planar_block), tmp_path_factory.mktemp("report"))


def cells(page: str, label: str) -> list[str]:
    """Texts of all cells of a column."""
    return re.findall(rf'<td data-label="{re.escape(label)}">(.*?)</td>', page)


@pytest.mark.slow
def test_nothing_is_fetched_from_elsewhere(page: str) -> None:
    assert not re.search(r"src=|(href=\"|url\()(?!#)|https?://|@import|<script", page)


@pytest.mark.slow
def test_every_drawing_is_well_formed(page: str) -> None:
    drawings = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert len(drawings) >= 10
    for drawing in drawings:
        ElementTree.fromstring(drawing)


@pytest.mark.slow
def test_every_reference_within_the_page_has_one_target(page: str) -> None:
    names = re.findall(r' id="([^"]+)"', page)
    assert len(names) == len(set(names))
    assert set(re.findall(r'(?:href="|url\()#([\w.]+)', page)) == set(names)


@pytest.mark.slow
def test_every_parameter_and_warning_is_on_the_page(page: str, planar_block: Block) -> None:
    estimator = Estimator(load_system("paper-planar"), planar_block.channels, "test")
    for p in estimator.base.parameters:
        assert p.name in page.replace("<wbr>", "")
    assert "a warning with &lt;angle brackets&gt;" in page


@pytest.mark.slow
def test_a_nominal_value_is_beside_each_estimate(page: str, planar_block: Block) -> None:
    estimator = Estimator(load_system("paper-planar"), planar_block.channels, "test")
    nominal = estimator.base.values(estimator.model.nominal)
    np.testing.assert_allclose([float(cell) for cell in cells(page, "nominal")], nominal, rtol=1e-5)


@pytest.mark.long
def test_an_unstated_nominal_value_is_left_out(planar_block: Block, tmp_path: Path) -> None:
    session, course = watched(planar_block)
    (stated, value), *_ = nominal = [(p.name, p.nominal) for p in session.estimator.base.parameters]
    scene = Scene(session.estimator.model)
    page = write_report(tmp_path, session.result.document(), course, {stated: value}, scene).read_text()
    assert cells(page, "nominal") == [f"{value:.6g}"] + [""] * (len(nominal) - 1)
    assert [bool(cell) for cell in cells(page, "% off nominal")] == [True] + [False] * (len(nominal) - 1)


@pytest.mark.long
def test_the_same_session_gives_the_same_page(page: str, planar_block: Block, tmp_path: Path) -> None:
    # How fast the computer was is no property of the session.
    assert report_of(*watched(planar_block), tmp_path, throughput=2000.0) == page


@pytest.mark.slow
def test_matplotlib_waits_for_the_first_page() -> None:
    modules = "sms_tools.showing", "sms_tools.verbs.replay", "sms_tools.verbs.diagnose"
    code = f"import sys, {', '.join(modules)}; sys.exit(any(name in sys.modules for name in ('matplotlib', 'jinja2')))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.slow
def test_the_page_of_a_long_session_stays_small(tmp_path: Path) -> None:
    """Of the arm with most parameters, all determined, each of them as rough as can be, with as many instants as
    course and results.json hold."""
    system = load_system("seven-joint")
    model = build_model(system)
    channels = tuple(system_channels(model.layout))
    estimator = Estimator(system, channels, "test")
    document = results_document(estimator, 1000.0, [])
    rng = np.random.default_rng(2)
    for p in document["parameters"]:
        p |= {"identifiable": True, "estimate": 1.0, "std": 0.1, "lower95": 0.8, "upper95": 1.2}
    t, n, size = np.linspace(0.0, 3600.0, MOST_INSTANTS), estimator.base.n, (MOST_WRITTEN, estimator.base.n)
    names, units = zip(*((p.name, p.unit) for p in estimator.base.parameters), strict=True)
    upper = np.zeros((MOST_WRITTEN, n * (n + 1) // 2))
    upper[:, np.equal(*np.triu_indices(n))] = (0.1 * rng.random(size)) ** 2
    estimate = 1.0 + 0.1 * rng.standard_normal(size)
    document["history"] = [History("rls", True, names, units, t[:MOST_WRITTEN], estimate, upper).document()]
    x = np.tile(np.eye(model.layout.n_x)[6], (MOST_INSTANTS, 1))
    course = Course(t, rng.random((MOST_INSTANTS, len(system.joints))), t, x)
    assert write_report(tmp_path, document, course, {}, Scene(model)).stat().st_size < LARGEST


def system_channels(layout: Layout) -> list[str]:
    return [*layout.position_names, *(f"tau_{i}" for i in range(1, len(layout.q) + 1))]


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium; tools/install_browser.sh installs it")
@pytest.mark.parametrize("width", [400, 1400])
def test_every_estimate_is_within_the_window(page: str, tmp_path: Path, width: int) -> None:
    from playwright.sync_api import sync_playwright

    (tmp_path / "report.html").write_text(page)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        window = browser.new_page(viewport={"width": width, "height": 900})
        window.goto((tmp_path / "report.html").as_uri())
        assert window.evaluate("document.documentElement.scrollWidth") <= width
        boxes = [cell.bounding_box() for cell in window.locator("tbody td:not(:empty)").all()]
        browser.close()
    assert len(boxes) > 16 * 8
    for box in boxes:
        assert box is not None
        assert box["x"] >= 0.0
        assert box["x"] + box["width"] <= width


@pytest.mark.slow
def test_a_course_of_a_long_session_is_thinned_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(course_module, "MOST_INSTANTS", 20)
    block = axis_block(coulomb=0.0)
    session = Session(load_system(tomllib.loads(AXIS)), block.channels)
    recorder = CourseRecorder(session)
    for piece in recorder.watch([block]):
        session.update(piece)
    session.finish()
    course = recorder.course
    for t, rows in ((course.tested, course.residual), (course.seen, course.x)):
        assert 10 <= t.size <= 21
        assert t.size == len(rows)
        # All but the last step, which ends with the session.
        steps = np.diff(t)[:-1]
        assert 0.0 < steps.max() <= 2.0 * steps.min()
    assert course.tested[-1] == block.t[-1]


@pytest.mark.slow
def test_replay_writes_it_beside_the_results(tmp_path: Path, planar_block: Block) -> None:
    capture = tmp_path / "run.csv"
    with CaptureWriter(capture, planar_block.channels) as writer:
        writer.write(Block(planar_block.t[:2000], planar_block.channels, planar_block.values[:2000]))
    assert main(["replay", str(capture), "--system", "paper-planar", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "results.json").read_text())
    assert found["system"]["title"] in (tmp_path / "report.html").read_text()


def curves(svg: str, color: str) -> list[str]:
    """Paths of a drawing's lines of a colour, as they are written."""
    return re.findall(rf'<path d="([^"]*)"[^>]*style="fill: none; [^"]*stroke: var\(--{color}\)', svg)


def test_a_gap_interrupts_a_line() -> None:
    y = np.array([0.0, 1.0, np.nan, 1.0, 2.0, 4.0])
    (line,) = curves(chart("c", [Series("a", np.arange(6.0), y)], "x").svg, "blue")
    assert line.count("M") == 2


def test_a_share_of_one_instant_is_no_chart() -> None:
    empty = np.empty((3, 0))
    shares = np.array([[np.nan, np.nan], [np.nan, 0.1], [0.2, 0.1]])
    one, more = (Course(np.arange(3.0), each, np.empty(0), empty) for each in (shares[:, :1], shares))
    assert _residual(one) == []
    (drawn,) = _residual(more)
    assert [label for label, _, _ in drawn.key] == ["joint 2"]


def test_an_axis_holds_the_lines_not_their_bounds() -> None:
    x, y = np.arange(3.0), np.array([0.0, 1.0, 2.0])
    wide = Series("a", x, y, y - 1000.0, y + 1000.0)
    ticks = [re.findall(r"<text[^>]*>([^<]*)<", chart("c", [each], "x").svg) for each in (Series("a", x, y), wide)]
    assert ticks[0] == ticks[1]


def test_drawings_have_the_colours_of_the_page() -> None:
    svg = chart("c", [Series("a", np.arange(3.0), np.arange(3.0))], "x", marks=[1.0]).svg
    assert not re.search("#[0-9a-f]{6}\\b", svg)
    assert set(re.findall(r"var\(--(\w+)\)", svg)) <= set(PALETTE)
    light = [light for light, _ in PALETTE.values()]
    assert len(light) == len(set(light))


@pytest.mark.parametrize("name", ["paper-planar", "seven-joint", "emps"])
def test_any_arm_can_be_drawn(name: str) -> None:
    scene = Scene(build_model(load_system(name)))
    x = np.zeros((3, scene.model.layout.n_x))
    if name == "seven-joint":
        x[:, 6] = 1.0
    for figure in arm_drawings(scene, x, [0, 2], ["a", "b"]):
        ElementTree.fromstring(figure.svg)


@pytest.mark.parametrize("link", ["center_of_mass = [0.2, 0.1, 0.0]", ""])
def test_a_rigid_link_without_a_tip_is_no_dot(link: str) -> None:
    (picture,) = arm_drawings(rigid_axis("revolute", link), np.zeros((1, 1)), [0], ["a"])
    (line,) = curves(picture.svg, "ink")
    ends = np.array(re.findall(r"[\d.]+", line), dtype=float).reshape(-1, 2)
    # A picture is 150 pt high, a joint's dot 7 pt wide.
    assert np.ptp(ends, axis=0).max() > 30.0


def test_figure_6_shows_angles_rates_and_torques(planar_session: Simulation) -> None:
    figures = figure_6(planar_session)
    assert [len(figure.key) for figure in figures] == [4, 4, 2]
    for figure in figures:
        for _, color, _ in figure.key:
            assert len(curves(figure.svg, color)) == 1


def test_a_bar_that_goes_on_beyond_its_scale_says_so() -> None:
    bars = [error_bar(deviation, bound, 1.0, "blue") for deviation, bound in ((0.0, 0.9), (0.5, 0.9), (0.0, 3.0))]
    assert [(bar.below, bar.above) for bar in bars if bar] == [(False, False), (False, True), (True, True)]
    outside = error_bar(-2.0, 0.5, 1.0, "blue")
    assert outside is not None
    assert (outside.start, outside.end, outside.middle) == (0.0, 0.0, None)
    assert error_bar(0.0, np.nan, 1.0, "blue") is None


def test_what_is_determined_late_fills_its_axis() -> None:
    count, unknown = 21, 12
    courses = {"estimate": 1.001, "std": 5e-4}
    late = {name: [None] * unknown + [value] * (count - unknown) for name, value in courses.items()}
    history = {"judged": True, "t": np.linspace(0.0, 4.0, count).tolist(), "parameters": [{"name": "mass", **late}]}
    parameters = [{"name": "mass", "symbol": "m", "unit": "kg", "true": 1.0}]
    (drawing,) = _convergence({"parameters": parameters, "history": [history], "events": []}, {"mass": 1.0})
    # It deviates by 0.1 %, ± 0.1 %; numbers of time are not negative.
    lowest = max(map(float, re.findall(r">−([\d.]+)</text>", drawing.svg)))
    assert 0.2 <= lowest < 1.0


@pytest.mark.slow
def test_the_judgement_is_the_first_thing_on_the_page(page: str) -> None:
    assert page.index('class="judgement trust"') < page.index("<h1>")
    assert "Trust: 16 of 16 parameters determined" in page
