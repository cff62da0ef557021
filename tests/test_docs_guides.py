"""Guides and README work as they are printed."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from tracker_rows import PI_TRUE, N, exciting_rows, rows_of

from sms_online.trackers import Information, RecursiveLeastSquares, Rows

ROOT = Path(__file__).parents[1]
LARGEST_README = 6000  # bytes
# Of estimation and diagnosis the field has words of its own, see docs/explanation/glossary.md.
RETIRED = (
    r"\btells?\b", r"\btold\b", r"\bbears?\b", r"\bborne\b", r"\bleaves? open\b", r"\bleft open\b", r"\bsettles?\b",
    r"what holds an axis", r"\btaken up\b", r"no real bodies",
)  # fmt: skip


def blocks(path: str, language: str) -> list[str]:
    return re.findall(
        rf"^```{language}\n(.*?)^```", (ROOT / path).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_bytes()) <= LARGEST_README


def test_pages_use_the_fields_words() -> None:
    pages = [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "docs").rglob("*.ipynb"),
    ]
    found = [
        f"{page.relative_to(ROOT)}: {match[0]}"
        for page in pages
        for word in RETIRED
        for match in re.finditer(word, page.read_text(encoding="utf-8"))
    ]
    assert found == []


def guide_tracker() -> Any:
    (code,) = blocks("docs/how-to/add-a-tracker.md", "python")
    assert len(code.splitlines()) <= 60
    module = ModuleType("fading")
    exec(compile(code, "add-a-tracker.md", "exec"), module.__dict__)
    return module.FadingLeastSquares


def test_the_guides_tracker_without_fading_is_least_squares() -> None:
    """Rows of seed 1; a memory of 1e12 s is none. The information matrix squares a condition number of 1.2."""
    rows = exciting_rows(seed=1, count=500)
    tracker, reference = guide_tracker()(N, 1e12), RecursiveLeastSquares(N)
    for part in (slice(0, 100), slice(100, 100), slice(100, None)):
        tracker.update(Rows(rows.Y[part], rows.b[part], rows.std[part], rows.t[part]))
    reference.update(rows)
    one, other = tracker.estimate(), reference.estimate()
    np.testing.assert_allclose(one.pi, other.pi, rtol=1e-8)
    np.testing.assert_allclose(one.std, other.std, rtol=1e-8)
    np.testing.assert_allclose(
        [one.rss, one.dof, one.condition_number], [other.rss, other.dof, other.condition_number], rtol=1e-6
    )


def test_the_guides_tracker_goes_on_from_what_others_know() -> None:
    rows = exciting_rows(seed=5, count=500)
    tracker, reference = guide_tracker()(N, 1e12), guide_tracker()(N, 1e12)
    tracker.begin(Information.none(N).with_rows(rows.whitened(N)))
    reference.update(rows)
    one, other = tracker.estimate(), reference.estimate()
    np.testing.assert_allclose(one.pi, other.pi, rtol=1e-8)
    np.testing.assert_allclose([one.rows, one.dof], [other.rows, other.dof], rtol=1e-9)


def test_the_guides_tracker_follows_a_change_and_goes_on_after_a_save() -> None:
    """Rows of seeds 2 and 3, 1 kHz: half a second after a jump a memory of 50 ms holds nothing of what was before."""
    tracker, after = guide_tracker()(N, 0.05), exciting_rows(seed=3, count=500)
    tracker.update(exciting_rows(seed=2, count=500, pi=-PI_TRUE))
    saved = tracker.state()
    other = guide_tracker()(N, 0.05)
    other.restore(saved)
    later = Rows(after.Y, after.b, after.std, after.t + 0.5)
    for each in (tracker, other):
        each.update(later)
    estimate = tracker.estimate()
    assert (np.abs(estimate.pi - PI_TRUE) < 5.0 * estimate.std).all()
    assert np.array_equal(estimate.pi, other.estimate().pi)


def test_the_guides_tracker_names_what_is_not_determined() -> None:
    tracker = guide_tracker()(N, 1e12)
    assert not tracker.estimate().determined.any()
    Y = np.random.default_rng(4).normal(size=(300, N))
    Y[:, 4] = 0.0
    tracker.update(rows_of(Y, Y @ PI_TRUE))
    assert list(tracker.estimate().determined) == [True] * 4 + [False, True]
    with pytest.raises(ValueError, match="7 columns"):
        tracker.update(rows_of(np.ones((1, N + 1)), np.ones(1)))


@pytest.mark.slow
def test_the_readmes_python_runs_as_it_stands_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seed 0; what the text after each block says of it is checked too."""
    first, second = blocks("README.md", "python")
    scope: dict[str, Any] = {}
    exec(compile(first, "README.md", "exec"), scope)
    assert scope["result"].trust.level == "doubt"
    assert [f"{found.name}@{found.where}" for found in scope["found"].effects] == ["coulomb_friction@joint_2"]
    assert scope["better"].trust.level == "trust"
    assert abs(scope["better"].parameters["coulomb_friction@joint_2.torque"].value - 8.0) < 0.05
    exec(compile(second, "README.md", "exec"), scope)
    scope["session"].finish()
    live, whole = scope["session"].result.parameters, scope["result"].parameters
    assert {name: p.value for name, p in live.items()} == {name: p.value for name, p in whole.items()}
