"""The README is short, pages and code use the field's words, and the guide's tracker is one."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

import sms_online as sms
from sms_online.description.parse import parse_system
from sms_online.trackers import RecursiveLeastSquares, Rows
from sms_online.trackers.build import KINDS
from tests.axis import AXIS, axis_block
from tests.guide import fading
from tests.tracker_rows import PI_TRUE, N, exciting_rows, rows_of

ROOT = Path(__file__).parents[1]
LARGEST_README = 6000  # bytes
LARGEST_NOTEBOOK = 100_000  # characters
# Outputs of a notebook that ran to its end.
HARMLESS = {"stream", "execute_result", "display_data"}
# Of estimation and diagnosis the field has words of its own, see docs/explanation/glossary.md.
RETIRED = (
    r"(?<!\.)\b(tells?|telling|told)\b", r"\b(bears?|borne)\b", r"\bleaves? open\b", r"\bleft open\b", r"\bstands?\b",
    r"\bsettle[sd]?\b", r"\btaken up\b", r"\bworked off\b", r"\blooked at\b", r"\bholds an axis\b", r"\breal bodies\b",
)  # fmt: skip


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_bytes()) <= LARGEST_README


def retired(paths: Iterable[Path]) -> list[str]:
    """Words that the field does not use, each with its file."""
    return [
        f"{path.relative_to(ROOT)}: {match[0]}"
        for path in paths
        for word in RETIRED
        for match in re.finditer(word, path.read_text(encoding="utf-8"), re.IGNORECASE)
    ]


def test_pages_use_the_fields_words() -> None:
    docs = ROOT / "docs"
    assert retired([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *docs.rglob("*.md"), *docs.rglob("*.ipynb")]) == []


@pytest.mark.parametrize("package", ["sms_online", "adapters", "sim", "tools"])
def test_code_uses_the_fields_words(package: str) -> None:
    assert retired((ROOT / package).rglob("*.py")) == []


def test_tutorials_hold_the_outputs_of_one_run_and_no_paths() -> None:
    for path in (ROOT / "docs" / "tutorials").glob("*.ipynb"):
        text = path.read_text(encoding="utf-8")
        cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
        assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1)), path.name
        assert {output["output_type"] for cell in cells for output in cell["outputs"]} <= HARMLESS, path.name
        assert not re.search(r"(?<![\w.])/(home|root|tmp|Users|work)/", text), path.name
        assert len(text) < LARGEST_NOTEBOOK, path.name


def test_the_architecture_page_names_every_module_once() -> None:
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`.*?`) \|", page.split("## Inside sms_online")[1], re.MULTILINE)
    named = [name for row in rows for name in re.findall(r"`([^`]+)`", row)]
    here = [path for path in (ROOT / "sms_online").iterdir() if not path.name.startswith(("_", "."))]
    modules = {path.name for path in here if path.suffix == ".py"}
    folders = {f"{path.name}/" for path in here if (path / "__init__.py").exists()}
    assert sorted(named) == sorted(modules | folders)


def test_the_guides_tracker_without_fading_is_least_squares() -> None:
    """Rows of seed 1; a memory of 1e12 s is none. The information matrix squares a condition number of 1.2."""
    rows = exciting_rows(seed=1, count=500)
    tracker, reference = fading(N, 1e12), RecursiveLeastSquares(N)
    for each in (tracker, reference):
        each.update(rows)
    one, other = tracker.estimate(), reference.estimate()
    np.testing.assert_allclose(one.pi, other.pi, rtol=1e-8)
    np.testing.assert_allclose(one.std, other.std, rtol=1e-8)
    numbers = ("rss", "dof", "condition_number")
    np.testing.assert_allclose([getattr(one, k) for k in numbers], [getattr(other, k) for k in numbers], rtol=1e-6)


@pytest.mark.slow
def test_the_guides_tracker_follows_a_change() -> None:
    """Rows of seeds 2 and 3, 1 kHz: half a second after a jump a memory of 50 ms holds nothing of what was before."""
    tracker, after = fading(N, 0.05), exciting_rows(seed=3, count=500)
    tracker.update(exciting_rows(seed=2, count=500, pi=-PI_TRUE))
    tracker.update(Rows(after.Y, after.b, after.std, after.t + 0.5))
    estimate = tracker.estimate()
    assert (np.abs(estimate.pi - PI_TRUE) < 5.0 * estimate.std).all()


@pytest.mark.slow
def test_the_guides_tracker_is_chosen_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judged, with the tolerances of clocks and sensors as its prior, it estimates as exponential forgetting does."""
    monkeypatch.setitem(KINDS, "fading", lambda choice, for_: fading(for_.n, choice.memory or 10.0, for_.prior))
    block, system = axis_block(coulomb=0.0), parse_system(AXIS, "axis")
    data = sms.Capture(block.t, block.channels, block.values)
    own = sms.estimate(system, data, tracker="fading:memory=3")
    like = sms.estimate(system, data, tracker="rls:forgetting=exponential,memory=3")
    assert own.trackers[0].name == "fading 3 s"
    for one, other in zip(own.parameters.values(), like.parameters.values(), strict=True):
        assert one.value == pytest.approx(other.value, abs=0.2 * other.std)
        assert one.std == pytest.approx(other.std, rel=0.1)


def test_the_guides_tracker_names_what_is_not_determined() -> None:
    """Rows of seed 4, one parameter without a column."""
    tracker = fading(N, 1e12)
    Y = np.random.default_rng(4).normal(size=(300, N))
    Y[:, 4] = 0.0
    tracker.update(rows_of(Y, Y @ PI_TRUE))
    assert list(tracker.estimate().determined) == [True] * 4 + [False, True]
