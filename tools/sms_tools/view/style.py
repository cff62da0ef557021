"""Colours of all views, so that one thing looks the same in each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_online.row_types import LARGEST_RESIDUAL
from sms_online.stream import Array
from sms_online.verdict.trust import Trust

Color = tuple[int, int, int]
BASE: Color = (110, 120, 135)
LINK: Color = (235, 235, 235)
GHOST: Color = (85, 95, 110)
JOINT: Color = (120, 150, 200)
TIP: Color = (90, 200, 250)
TRACKED: Color = (190, 130, 250)
EVENT: Color = (240, 90, 90)
REFERENCE: Color = (140, 140, 140)
# Lines of a plot, for people with any colour vision. Source: M. Okabe, K. Ito, Color Universal Design (2008).
LINES: tuple[Color, ...] = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (200, 180, 40),  # theirs is lighter, and lost on a light theme
    (213, 94, 0),
    (204, 121, 167),
    (0, 114, 178),
)
# Of the arm's view, whatever theme the viewer has.
BACKGROUND: Color = (14, 17, 22)
BOUNDS_ALPHA = 110
# Of a verdict.
TRUST: Color = (32, 150, 70)
CAUTION: Color = (225, 150, 20)
GRAVE: Color = (205, 35, 35)
NOT_YET: Color = (110, 115, 125)
GOOD, BAD = np.array((60.0, 190.0, 120.0)), np.array((235.0, 60.0, 60.0))


def verdict_color(trust: Trust) -> Color:
    """Green, amber, red, or grey while it is too early."""
    if trust.level == "doubt":
        return GRAVE if trust.grave else CAUTION
    return TRUST if trust.level == "trust" else NOT_YET


def translucent(color: Color) -> tuple[int, int, int, int]:
    """The same colour for what accompanies a line: its error bounds."""
    return *color, BOUNDS_ALPHA


def residual_colors(relative: Array) -> NDArray[np.uint8]:
    """Colours (..., 3) of relative residuals (...), from green to the red at which a warning is given.

    NaN, where nothing is known yet, is green.
    """
    share = np.clip(np.nan_to_num(relative) / LARGEST_RESIDUAL, 0.0, 1.0)[..., None]
    return np.asarray(GOOD + share * (BAD - GOOD)).astype(np.uint8)
