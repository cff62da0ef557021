"""diagnosis.html: self-contained, well-formed, and showing the law that the data follow where the effect sits."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from sms_adapters.capture import CaptureWriter
from sms_adapters.system_file import load_system
from sms_online.description.channels import channels
from sms_online.description.parse import parse_system
from sms_online.description.schema import Effect, Fitted
from sms_online.diagnosis.diagnose import diagnose
from sms_online.diagnosis.document import diagnosis_document
from sms_online.diagnosis.force_curves import added_variables, force_curves
from sms_online.diagnosis.search import Search
from sms_online.diagnosis.unexplained import describe_residual
from sms_online.effects.build import build_model
from sms_online.truth import true_values
from sms_tools.adopted_system import added_lines, adopted_text, remarks
from sms_tools.cli import main
from sms_tools.html_report.arm_drawing import marked_arm
from sms_tools.html_report.diagnosis_page import write_diagnosis
from sms_tools.report import Document
from sms_tools.view.places import places_of
from sms_tools.view.scene import Scene
from tests.axis import AXIS, axis_block

COULOMB = 0.2  # N m
# rad/s; where the axis turns, its filter's half width of 14 samples blurs the speed by up to 11 rad/s² times 0.07 s.
TURNING = 0.8


def diagnosed(coulomb: float) -> Search:
    return diagnose(parse_system(AXIS, "axis"), [axis_block(coulomb)], "test", lambda estimator: None)


@pytest.fixture(scope="module")
def diagnosis() -> Search:
    """Of the axis with Coulomb friction."""
    return diagnosed(COULOMB)


def page_of(diagnosis: Search, directory: Path, added: list[str]) -> tuple[Document, str]:
    document = diagnosis_document(diagnosis, ["a warning with <angle brackets>"], None)
    return document, write_diagnosis(directory, document, diagnosis, "run.csv", added).read_text()


@pytest.mark.slow
def test_the_curve_from_the_data_is_the_friction_that_was_there(diagnosis: Search) -> None:
    (curve,) = force_curves(diagnosis)
    assert [effect.name for effect in curve.effects] == ["coulomb_friction"]
    moving = np.abs(curve.at) > TURNING
    for force in (curve.force, curve.law):
        np.testing.assert_allclose(force[moving], -COULOMB * np.sign(curve.at[moving]), rtol=0.03)
    assert added_variables(diagnosis) == []


def test_the_page_is_whole_and_well_formed(diagnosis: Search, tmp_path: Path) -> None:
    document, page = page_of(diagnosis, tmp_path, ['name = "coulomb_friction" # & more'])
    assert not re.search(r"src=|(href=\"|url\()(?!#)|https?://|@import|<script", page)
    drawings = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert len(drawings) >= 3
    for drawing in drawings:
        ElementTree.fromstring(drawing)
    names = re.findall(r' id="([^"]+)"', page)
    assert len(names) == len(set(names)) >= 3
    assert document["summary"] in page
    assert "a warning with &lt;angle brackets&gt;" in page
    assert "# &amp; more" in page
    assert "found: 1" in page
    for p in document["after"]["parameters"]:
        assert p["name"] in page.replace("<wbr>", "")


def test_candidates_are_drawn_by_the_share_that_they_explain(diagnosis: Search, tmp_path: Path) -> None:
    _, page = page_of(diagnosis, tmp_path, [])
    drawn = [float(width) for width in re.findall(r'class="share.*?width: ([\d.]+)%', page)]
    assert drawn == sorted(drawn, reverse=True)
    before, after = (float(np.sum(state.residual**2)) for state in (diagnosis.before, diagnosis.after))
    # Windows overlap, and only the shares are of rows that count what these have in common once.
    assert drawn[0] == pytest.approx(100.0 * (1.0 - after / before), abs=1.0)
    # What explains no more than chance is not among them.
    assert len(drawn) < len(diagnosis.ranking)


def test_what_was_found_has_no_nominal_value(diagnosis: Search, tmp_path: Path) -> None:
    document, page = page_of(diagnosis, tmp_path, [])
    nominal = re.findall(r'<td data-label="nominal">(.*?)</td>', page)
    stated = {p.name: p.nominal for p in diagnosis.estimator_before.base.parameters}
    names = [p["name"] for p in document["after"]["parameters"]]
    assert nominal == [f"{stated[name]:.6g}" if stated.get(name) else "" for name in names]
    assert "" in nominal


@pytest.mark.long
def test_the_same_session_gives_the_same_page(diagnosis: Search, tmp_path: Path) -> None:
    assert page_of(diagnosis, tmp_path, [])[1] == page_of(diagnosed(COULOMB), tmp_path, [])[1]


@pytest.mark.slow
def test_a_clean_session_has_a_page_without_effects(tmp_path: Path) -> None:
    document, page = page_of(diagnosed(0.0), tmp_path, [])
    assert document["verdict"] == "clean"
    assert "What and where" not in page
    assert "before and after" not in page
    assert 'class="share' not in page
    assert "none explains more of the residual than chance" in page


def test_what_nothing_explains_is_marked_and_drawn(diagnosis: Search, tmp_path: Path) -> None:
    before, rows = diagnosis.before, diagnosis.attempt.rows
    unexplained = describe_residual(rows, diagnosis.attempt.tracing.columns([]), before.residual, before.test)
    nothing = {"verdict": "unexplained", "findings": [], "chosen": [], "after": before}
    _, page = page_of(replace(diagnosis, **nothing, unexplained=unexplained), tmp_path, [])
    assert re.findall(r"<text[^>]*font-weight: 700[^>]*>([^<]*)<", page) == ["?"]
    assert f"a free curve over {unexplained.variable} in {unexplained.speed} explains" in page
    assert "force in place of what is unknown" in page


@pytest.mark.long
def test_diagnose_writes_the_page_beside_its_document(tmp_path: Path) -> None:
    system, capture, block = tmp_path / "axis.toml", tmp_path / "run.csv", axis_block(COULOMB)
    system.write_text(AXIS)
    with CaptureWriter(capture, block.channels) as writer:
        writer.write(block)
    out = tmp_path / "out"
    assert main(["diagnose", str(capture), "--system", str(system), "--out", str(out)]) == 0
    page = (out / "diagnosis.html").read_text()
    assert json.loads((out / "diagnosis.json").read_text())["summary"] in page
    assert '[[effect]]\nname = "coulomb_friction"\nwhere = "joint_1"' in html.unescape(page)


def test_every_place_of_an_effect_is_marked() -> None:
    system = load_system("paper-planar")
    scene = Scene(build_model(system))
    x = np.zeros((3, scene.model.layout.n_x))
    places = {"base": "1", "joint_1": "2", "joint_2": "3, 4", "link_1": "5", "link_2": "6", "tip": "?"}
    drawing = marked_arm(scene, x, 1, places)
    assert re.findall(r"<text[^>]*font-weight: 700[^>]*>([^<]*)<", drawing) == list(places.values())
    # A ring about each joint and about the tip.
    assert len(re.findall("<use [^>]*stroke: var.--mark.", drawing)) == 3


@pytest.mark.parametrize(
    ("where", "places"),
    [
        ("tip", ["tip"]), ("joint_2", ["joint_2"]), ("q_1", ["joint_1"]), ("theta_m_*", ["joint_1", "joint_2"]),
        ("link_2.*", ["link_2"]), ("link_*.marker_*.u_*", ["link_1", "link_2"]), ("r_S_*", ["base"]),
    ],
)  # fmt: skip
def test_an_effect_on_channels_is_marked_at_their_sensors(where: str, places: list[str]) -> None:
    assert places_of(where, channels(load_system("paper-planar"))) == places


def test_only_what_a_system_file_gains_is_shown() -> None:
    system = load_system("paper-planar")
    found = Effect(name="cubic_stiffness", where="joint_1")
    after = system.model_copy(update={"effects": (*system.effects, found)})
    added = added_lines("paper-planar", adopted_text("paper-planar", system, after, {}))
    assert [line for line in added if line] == ["[[effect]]", 'name = "cubic_stiffness"', 'where = "joint_1"']


def test_what_was_found_is_remarked_in_the_system_file() -> None:
    def entry(name: str, estimate: float) -> dict[str, Any]:
        value = {"estimate": estimate, "std": 0.005, "unit": "N m"}
        return {"name": name, "where": "joint_1", "coefficients": {"torque": value}}

    found = remarks([entry("coulomb_friction", 20.0), entry("coulomb_friction", 21.0), entry("torque_delay", 0.02)])
    assert found["coulomb_friction@joint_1"] == "torque 20 ± 0.005 N m"
    system = load_system("paper-planar")
    late = Effect(name="torque_delay", where="joint_1", coefficients={"time": 0.02})
    after = system.model_copy(update={"effects": (Effect(name="coulomb_friction", where="joint_1"), late)})
    text = adopted_text("paper-planar", system, after, found)
    assert re.findall("# found: (.*)", text) == ["torque 20 ± 0.005 N m", "torque 0.02 ± 0.005 N m"]
    assert parse_system(text, "adopted").effects == after.effects


def test_what_was_injected_is_true_beside_what_was_found() -> None:
    system, name = load_system("paper-planar"), "coulomb_friction@joint_2.torque"
    found = Effect(name="coulomb_friction", where="joint_2", coefficients={"torque": 1.4})
    fitted = {name: Fitted(value=1.4, std=0.1)}
    adopted = system.model_copy(update={"effects": (*system.effects, found), "fitted": fitted})
    injected = found.model_copy(update={"coefficients": {"torque": 1.5}}).model_dump()
    assert true_values({"parameters": {}, "effects": [injected]}, adopted, adopted)[name] == 1.5


def test_effects_that_were_not_injected_are_truly_zero() -> None:
    system = load_system("paper-planar")
    named = [Effect(name="coulomb_friction", where=f"joint_{i}") for i in (1, 2)]
    adopted = system.model_copy(update={"effects": (*system.effects, *named)})
    injected = {"name": "coulomb_friction", "where": "joint_2", "coefficients": {"torque": 1.5}}
    true = true_values({"parameters": {"link_1.mass": 2.0}, "effects": [injected]}, system, adopted)
    assert true["coulomb_friction@joint_1.torque"] == 0.0
    assert true["coulomb_friction@joint_2.torque"] == 1.5
    assert true["link_1.mass"] == 2.0
    # What was injected where this system has no place for it is not compared.
    elsewhere = {"name": "coulomb_friction", "where": "joint_9", "coefficients": {"torque": 1.5}}
    compared = true_values({"parameters": {}, "effects": [elsewhere]}, system, adopted)
    assert "coulomb_friction@joint_9.torque" not in compared
