"""Units of logged numbers, by pint's names, to the SI unit of a channel."""

from __future__ import annotations

from functools import cache
from typing import Any

from sms_adapters.extras import installed
from sms_online.errors import InputError

# What a bench writes as one word, which pint would read as something else, or not at all.
WORDS = ("newton_meter = newton * meter = Nm", "newton_centimeter = newton * centimeter = Ncm")


def si_factor(unit: str, wanted: str, source: str, place: str) -> float:
    """How much of the unit `wanted` one `unit` is; InputError where it is none, or of another kind."""
    pint = installed("pint", source, place)
    try:
        ours, theirs = (_registry().parse_units(text) for text in (wanted, unit))
    # What pint raises of a text that is no unit is Python's as often as its own.
    except Exception:
        expected = f"a unit by pint's names, such as {wanted!r} or 'mN m'"
        raise InputError(source, place, repr(unit), expected) from None
    if "hertz" in str(theirs) and "rad" in wanted:
        found = f"{unit!r}, which may count turns or radians"
        raise InputError(source, place, found, f"'rpm', 'deg/s' or {wanted!r}")
    try:
        return float(_registry().Quantity(1.0, theirs).to(ours).magnitude)
    except pint.PintError:
        raise InputError(source, place, repr(unit), f"a unit of what is measured in {wanted!r}") from None


@cache
def _registry() -> Any:
    import pint

    registry: Any = pint.UnitRegistry()
    for word in WORDS:
        registry.define(word)
    return registry
