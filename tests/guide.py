"""The effect that the guide for contributors adds, as it is written there."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np

from sms_online.effects.base import Entry, Force
from sms_online.effects.friction import MotorSide


def windage() -> type[Force]:
    """Its class."""
    guide = (Path(__file__).parent.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    code = guide.split("    class WindageFriction")[1].split("\n\nList the class")[0]
    names = {"np": np, "MotorSide": MotorSide, "Entry": Entry, "Mapping": Mapping}
    exec(textwrap.dedent(f"    from __future__ import annotations\n\n    class WindageFriction{code}"), names)
    return cast(type[Force], names["WindageFriction"])
