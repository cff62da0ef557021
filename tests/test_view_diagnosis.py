"""A diagnosis in view: the session with what was found, the evidence of the candidates and the verdict."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sms_adapters.capture import CaptureWriter
from sms_tools.cli import main
from tests.axis import AXIS, axis_block
from tests.recordings import columns, scalars

pytestmark = pytest.mark.long
COULOMB = 0.2  # N m


@pytest.fixture(scope="module", params=[[], ["--prior"]], ids=["", "prior"])
def diagnosed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of the diagnosis of an axis with Coulomb friction, with a recording; also with a prior.

    With one the parameters come from the rows of the diagnosis, not from a session.
    """
    folder = tmp_path_factory.mktemp("diagnosed")
    (folder / "axis.toml").write_text(AXIS)
    block = axis_block(COULOMB)
    with CaptureWriter(folder / "run.csv", block.channels) as writer:
        writer.write(block)
    arguments = ["diagnose", str(folder / "run.csv"), "--system", str(folder / "axis.toml"), "--out", str(folder)]
    assert main([*arguments, "--rerun", "save", *request.param]) == 0
    return folder


@pytest.fixture(scope="module")
def document(diagnosed: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((diagnosed / "diagnosis.json").read_text())
    return found


def test_the_recording_ends_with_the_parameters_after(diagnosed: Path, document: dict[str, Any]) -> None:
    found = {p["symbol"]: (p["estimate"], p["std"]) for p in document["after"]["parameters"]}
    shown = {}
    for group in ("links", "effects"):
        recording, entity = diagnosed / "session.rrd", f"/parameters/{group}"
        names = columns(recording, f"{entity}/estimate")[0]["SeriesLines:names"]
        last = [scalars(recording, f"{entity}/{number}")[1][-1].tolist() for number in ("estimate", "std")]
        shown |= dict(zip(names, zip(*last, strict=True), strict=True))
    assert shown == found


def test_evidence_is_drawn_and_no_other_effect_has_more(diagnosed: Path, document: dict[str, Any]) -> None:
    (effect,) = document["effects"]
    assert effect["name"] == "coulomb_friction"
    evidence = {}
    for candidate in document["candidates"][:3]:
        entity = f"/evidence/{candidate['name']}\\@{candidate['where']}"
        t, evidence[candidate["name"]] = scalars(diagnosed / "session.rrd", entity)
        assert t.tolist() == [0.0, pytest.approx(2399 / 200.0)]
    # Pre-sliding friction contains it, and gains what chance gives one more coefficient.
    most = max(float(scores[0, 0]) for scores in evidence.values())
    assert float(evidence["coulomb_friction"][0, 0]) == pytest.approx(most, abs=0.01)


def test_the_verdict_is_in_the_log(diagnosed: Path, document: dict[str, Any]) -> None:
    lines = [row["TextLog:text"][0] for row in columns(diagnosed / "session.rrd", "/log") if row.get("TextLog:text")]
    assert f"11.99 s: {document['summary']}" in lines


def test_the_judgement_is_on_top_and_marked_on_the_arm(diagnosed: Path, document: dict[str, Any]) -> None:
    words = [row["TextDocument:text"][0] for row in columns(diagnosed / "session.rrd", "/verdict/words")]
    assert words[-1].startswith("# DOUBT: the system file lacks coulomb\\_friction@joint\\_1")
    assert document["judgement"]["sentence"].startswith("Doubt: the system file lacks coulomb_friction@joint_1")
    (texts,) = {
        tuple(row["Points3D:labels"])
        for row in columns(diagnosed / "session.rrd", "/arm/mark_texts")
        if row.get("Points3D:labels")
    }
    assert texts == ("coulomb friction",)
    page = (diagnosed / "diagnosis.html").read_text()
    assert page.index('class="judgement') < page.index("<h1>")
