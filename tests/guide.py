"""The effect and the tracker that the guides add, as they are written there."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import cast

from sms_online.effects.base import Force
from sms_online.trackers import Prior, Tracker

HOW_TO = Path(__file__).parents[1] / "docs" / "how-to"
# What a guide asks for in one file, at most.
MOST_LINES = 60


def code_of(page: str, beginning: str) -> str:
    """The page's block of Python that begins so."""
    blocks = (HOW_TO / page).read_text(encoding="utf-8").split("```python\n")
    code = next(block for block in blocks if block.startswith(beginning)).split("```")[0]
    assert len(code.splitlines()) <= MOST_LINES, page
    return code


def windage() -> type[Force]:
    """The class of the effect."""
    code = code_of("add-an-effect.md", '"""Drag')
    names: dict[str, object] = {"__name__": "windage"}
    exec(compile(code, "add-an-effect.md", "exec"), names)
    return cast(type[Force], names["WindageFriction"])


def fading(n: int, memory: float, prior: Prior | None = None) -> Tracker:
    """The tracker, of n parameters and a memory in s."""
    module = ModuleType("fading")
    sys.modules[module.__name__] = module  # where the annotations of its state are evaluated
    exec(compile(code_of("add-a-tracker.md", "from __future__"), "add-a-tracker.md", "exec"), module.__dict__)
    return cast(Tracker, module.__dict__["FadingLeastSquares"](n, memory, prior))
