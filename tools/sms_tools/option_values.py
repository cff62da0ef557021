"""Readers of the values of options, for argparse."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

from sms_tools.view.choice import parse_choice

# Largest factor on deflections that are drawn: a deflection of a nanometre is seen at it.
MOST_MAGNIFIED = 1e6


def seconds(positive: bool = False) -> Callable[[str], float]:
    """Reader of a time that is not negative, or positive."""

    def read(text: str) -> float:
        value = _number(text)
        if not (math.isfinite(value) and (value > 0 if positive else value >= 0)):
            expected = "greater than 0" if positive else "0 or more"
            raise argparse.ArgumentTypeError(f"{text!r}; expected a number of seconds, {expected}")
        return value

    return read


def rerun(text: str) -> str:
    """A value of --rerun."""
    try:
        parse_choice(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def positive(text: str) -> float:
    """A positive number."""
    value = _number(text)
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r}; expected a number greater than 0")
    return value


def magnification(text: str) -> float:
    """A positive factor that leaves a picture a picture."""
    value = positive(text)
    if value > MOST_MAGNIFIED:
        raise argparse.ArgumentTypeError(f"{text!r}; expected at most {MOST_MAGNIFIED:g}")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def whole(least: int) -> Callable[[str], int]:
    """Reader of a whole number of at least `least`."""

    def read(text: str) -> int:
        if not (text.isdecimal() and int(text) >= least):
            raise argparse.ArgumentTypeError(f"{text!r}; expected a whole number, {least} or more")
        return int(text)

    return read
