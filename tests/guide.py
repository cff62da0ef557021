"""The effect that the guide to effects adds, as it is written there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np

from sms_online.effects.base import Entry, Force
from sms_online.effects.friction import MotorSide

GUIDE = Path(__file__).parents[1] / "docs" / "how-to" / "add-an-effect.md"


def windage() -> type[Force]:
    """Its class."""
    blocks = GUIDE.read_text(encoding="utf-8").split("```python\n")
    code = next(block for block in blocks if block.startswith("class WindageFriction")).split("```")[0]
    names = {"np": np, "MotorSide": MotorSide, "Entry": Entry, "Mapping": Mapping}
    exec(f"from __future__ import annotations\n\n{code}", names)
    return cast(type[Force], names["WindageFriction"])
