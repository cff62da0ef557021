"""Parameters that change while a simulated arm moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sms_online.description.explain import hint, nearest
from sms_online.errors import InputError
from sms_online.model.model import Model
from sms_online.stream import Array

GRAMMAR = "PARAMETER:share=NUMBER,over=SECONDS, PARAMETER:by=NUMBER,over=SECONDS or PARAMETER:half_life=SECONDS"


@dataclass(frozen=True)
class ParameterDrift:
    """A parameter's slow change, or that of all that a body owns ("spacecraft"), in proportion.

    share: change as a share of the value before; by: in the parameter's unit instead. over: s in which it changes
    evenly, then it stays. half_life: s in which it halves, again and again, instead of a change. begin: s.
    """

    parameter: str
    share: float = 0.0
    by: float = 0.0
    over: float = 0.0
    half_life: float = 0.0
    begin: float = 0.0

    def course(self, t: Array) -> Array:
        """Part (B,) of the whole change that has happened at t (B,), s: of a half life, of all that there is."""
        since = np.maximum(np.asarray(t) - self.begin, 0.0)
        if self.half_life:
            return np.asarray(1.0 - 2.0 ** (-since / self.half_life))
        return np.asarray(np.minimum(since / self.over, 1.0))

    def direction(self, model: Model, pi: Array) -> Array:
        """The whole change of π (n_pi,); InputError for a parameter that the model does not have."""
        names = [p.name for p in model.parameters]
        owners = [name.rsplit(".", 1)[0] for name in names]
        moved = [k for k, name in enumerate(names) if self.parameter in (name, owners[k])]
        if not moved:
            near = hint(nearest(self.parameter, [*names, *owners]))
            raise InputError("drift", self.parameter, "no such parameter", f"a parameter of the system{near}")
        out = np.zeros(pi.size)
        out[moved] = self.by or (-1.0 if self.half_life else self.share) * pi[moved]
        return out

    def document(self) -> dict[str, Any]:
        """The entry of the truth beside a capture: no key without a meaning."""
        return {name: value for name, value in vars(self).items() if value}


def parse_drift(text: str) -> ParameterDrift:
    """A drift from a text such as "joint_1.stiffness:share=-0.1,over=60"; InputError where it is none."""
    parameter, _, options = text.partition(":")
    numbers: dict[str, float] = {}
    for option in filter(None, options.split(",")):
        key, _, value = option.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if key not in ("share", "by", "over", "half_life", "begin") or not math.isfinite(number):
            raise InputError("--drift", text, repr(option), GRAMMAR)
        numbers[key] = number
    changes = [name for name in ("share", "by", "half_life") if numbers.get(name)]
    ramp = changes in (["share"], ["by"]) and numbers.get("over", 0.0) > 0.0
    halving = changes == ["half_life"] and numbers["half_life"] > 0.0 and "over" not in numbers
    if not parameter or not (ramp or halving) or numbers.get("begin", 0.0) < 0.0:
        raise InputError("--drift", text, "no change that can be made", GRAMMAR)
    return ParameterDrift(parameter, **numbers)


def parsed(drifts: Sequence[str | ParameterDrift]) -> tuple[ParameterDrift, ...]:
    """Drifts as texts or records; InputError where one is none."""
    if isinstance(drifts, str):
        raise InputError("drift", "", repr(drifts), f"a list of drifts, [{drifts!r}]")
    return tuple(parse_drift(drift) if isinstance(drift, str) else drift for drift in drifts)


def drifted(model: Model, pi: Array, drifts: Sequence[ParameterDrift], t: Array) -> Array:
    """π (B, n_pi) at t (B,), s, of a model whose parameters were π (n_pi,) before."""
    out = np.broadcast_to(pi, (np.size(t), pi.size)).copy()
    for drift in drifts:
        out += drift.course(t)[:, None] * drift.direction(model, pi)
    return out
