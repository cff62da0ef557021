"""True values of a simulated capture for the parameters of a model that has gained effects."""

from __future__ import annotations

from typing import Any

from sms_online.description.schema import Effect, System
from sms_online.model.model import Model


def true_values(truth: dict[str, Any], described: System, adopted: System) -> dict[str, float]:
    """By name, of `truth` as read beside a capture; the effects of `adopted` that were not injected are truly zero."""
    injected = tuple(Effect.model_validate(effect) for effect in truth.get("effects", ()))
    declared = described.model_copy(update={"effects": (*described.effects, *injected)})
    stated = {p.name: p.nominal for p in Model(declared).parameters if "@" in p.name}
    absent = {p.name: 0.0 for p in Model(adopted).parameters if "@" in p.name}
    return absent | stated | dict(truth["parameters"])
