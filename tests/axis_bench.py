"""A working directory with an axis and a capture of it, as the command line's tests use it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.axis import AXIS, DAMPING, INERTIA, MOTION, capture_lines

MOVED = AXIS + MOTION
TRUTH = {"link_1.inertia": INERTIA, "viscous_friction@joint_1.damping": DAMPING}


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with an axis, one that a controller moves, and a capture of it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "axis.toml").write_text(AXIS)
    (tmp_path / "moved.toml").write_text(MOVED)
    (tmp_path / "run.csv").write_text("\n".join(capture_lines()) + "\n")
    return tmp_path


def document(directory: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((directory / "results.json").read_text())
    return found
