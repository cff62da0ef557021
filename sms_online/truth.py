"""True values of a simulated capture for the parameters of a model that has gained effects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sms_online.description.schema import Effect, System
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import check_effect
from sms_online.errors import InputError


def true_values(truth: Mapping[str, Any], described: System, adopted: System) -> dict[str, float]:
    """By name, of `truth` as read beside a capture; the effects of `adopted` that were not injected are truly zero.

    Effects that were injected into a system of another kind are left out. What `described` has found in an earlier
    session is no truth.
    """
    injected = tuple(e for e in map(Effect.model_validate, truth.get("effects", ())) if _fits(described, e))
    places = {effect.key for effect in injected}
    others = tuple(effect for effect in described.effects if effect.key not in places)
    declared = described.model_copy(update={"effects": (*others, *injected), "fitted": {}})
    stated = {p.name: p.nominal for p in build_model(declared).parameters if "@" in p.name}
    absent = {p.name: 0.0 for p in build_model(adopted).parameters if "@" in p.name}
    return absent | stated | dict(truth["parameters"])


def _fits(system: System, effect: Effect) -> bool:
    try:
        check_effect(system, effect, "", "truth")
    except InputError:
        return False
    return True
