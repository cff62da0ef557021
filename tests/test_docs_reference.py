"""Reference pages say what the program does: every channel, every key of the documents, and no more."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sms_online.description.channels import channels
from sms_online.description.parse import parse_system, shipped_systems, shipped_text
from sms_tools.cli import main

REFERENCE = Path(__file__).parents[1] / "docs" / "reference"
# Keys that a session may have and the simulated one below has not: nothing changes or drifts in it.
EVENTS = ("events[].", "trackers[].drifts[].")
# Of what a diagnosis need not find.
UNFOUND = ("drifts[].", "unexplained.", "mistakes[].", "calibration[].")


def keys_of_page(page: str) -> set[str]:
    """The first cells of the page's tables, several keys in one included."""
    rows = re.findall(r"^\| (`.*?`) \|", (REFERENCE / page).read_text(encoding="utf-8"), re.MULTILINE)
    return {key for row in rows for key in re.findall(r"`([^`]+)`", row)}


def test_channels_and_meanings_match_one_to_one() -> None:
    written = keys_of_page("channels.md") - {"t"} - set(shipped_systems())
    patterns = {key: re.sub(r"_(i|j|k)(?=\\\.|$)", r"_\\d+", re.escape(key)) for key in written}
    wrench = '\n[[wrench]]\nwhere = "link_1"\n'
    described = [parse_system(shipped_text(each) + wrench, each) for each in shipped_systems()]
    existing = {name for system in described for name in channels(system)}
    unused = {key for key, pattern in patterns.items() if not any(re.fullmatch(pattern, name) for name in existing)}
    assert {name for name in existing if not any(re.fullmatch(p, name) for p in patterns.values())} == set()
    assert unused == set()


def paths(value: Any, at: str = "") -> Iterator[str]:
    """Paths of all that is in a document, [] for the items of a list; of an empty object its own."""
    if isinstance(value, dict) and value:
        for key, item in value.items():
            yield from paths(item, f"{at}.{key}" if at else key)
    elif isinstance(value, list):
        yield f"{at}[]"
        for item in value:
            yield from paths(item, f"{at}[]")
    else:
        yield at


def check(page: str, document: dict[str, Any], absent: tuple[str, ...], whole: tuple[str, ...]) -> None:
    """Each path of the document is a key of the page and the other way round.

    absent: beginnings of keys that this document need not have. whole: beginnings of paths described elsewhere.
    """
    keys = keys_of_page(page)
    patterns = {key: re.compile(re.escape(key).replace(r"\*", r"[\w@.]+?")) for key in keys}
    there = {path for path in paths(document) if not path.startswith(whole)}
    leaves = {path for path in there if not path.endswith("[]")}
    assert {path for path in leaves if not any(p.fullmatch(path) for p in patterns.values())} - {"unexplained"} == set()
    missing = {key for key, p in patterns.items() if not any(p.fullmatch(path) for path in there)}
    assert {key for key in missing if not f"{key}.".startswith((*absent, *whole))} == set()


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six seconds of the planar example, grade B, seed 0, with friction that its description lacks."""
    path = tmp_path_factory.mktemp("documents") / "run.csv"
    effect = "coulomb_friction@joint_2:torque=8"
    options = ["--system", "paper-planar", "--grade", "B", "--duration", "6", "--effect", effect]
    assert main(["simulate", *options, "--capture", str(path)]) == 0
    return path


@pytest.mark.long
def test_results_json_has_the_keys_of_its_page(capture: Path, tmp_path: Path) -> None:
    described = tmp_path / "rig.toml"
    described.write_text(shipped_text("paper-planar") + "\n[tolerances]\n", encoding="utf-8")
    assert main(["replay", str(capture), "--system", str(described), "--out", str(tmp_path)]) == 0
    document = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert document["diagnosis"], "the friction was not noticed, so its keys are not tested"
    check("results.md", document, EVENTS, ("system.",))


@pytest.mark.long
def test_diagnosis_json_has_the_keys_of_its_page(capture: Path, tmp_path: Path) -> None:
    assert main(["diagnose", str(capture), "--system", "paper-planar", "--out", str(tmp_path)]) == 0
    document = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))
    assert document["effects"]
    check("diagnosis.md", document, UNFOUND, ("before.parameters", "after.parameters"))
