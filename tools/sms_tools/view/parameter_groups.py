"""Which parameters share a plot: those of one kind of body, in % of what they are compared with."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.model.parameters import Parameter
from sms_online.stream import Array, Indices
from sms_tools.view.frames import Reference

# Lines that a person can distinguish in one plot.
MOST_LINES = 6
# Longest label, characters.
LONGEST_LABEL = 18
KINDS = {"spacecraft": "spacecraft", "joint": "joints", "motor": "motors", "link": "links", "payload": "payload"}
EFFECTS = "effects"
# Half width of a plot of deviations from true values, %: estimates come close to them.
TRUE_RANGE = 0.2
# Half ranges of other axes, %, tried in this order until so large a share of what is drawn fits. The viewer labels
# powers of ten alone, so that of an axis to 5 only its zero would be labelled.
HALF_RANGES = (*(float(f"{step}e{power}") for power in range(-4, 2) for step in (1, 2)), 100.0)
FITTING = 0.75


@dataclass(frozen=True)
class Basis:
    """What estimates without a true value are compared with, and how far around it, %.

    about (n,): NaN where there is nothing to compare with, and nothing is drawn. name: of it, for titles.
    """

    about: Array
    name: str
    half_range: float


@dataclass(frozen=True)
class Group:
    """Parameters (by index) of one plot.

    path: entity. scale: what an estimate is divided by after its reference `zero` is subtracted. unit: of the plot, `%`
    for deviations. half_range: of the plot's axis, None where a true value of zero leaves no measure for it.
    """

    path: str
    kind: str
    title: str
    indices: Indices
    labels: tuple[str, ...]
    zero: Array
    scale: Array
    unit: str
    half_range: float | None


def half_range(reach: Array) -> float:
    """Half range, %, of an axis for what reaches so far (·,) from its middle."""
    reach = reach[np.isfinite(reach)]
    fits = [limit for limit in HALF_RANGES if reach.size and np.mean(reach <= limit) >= FITTING]
    return fits[0] if fits else HALF_RANGES[-1]


def parameter_groups(
    parameters: Sequence[Parameter], references: Sequence[Reference | None], basis: Basis
) -> list[Group]:
    """Groups of the base parameters, in their order: about true values where they are known, else about the basis."""
    sets: dict[tuple[str, str, bool], list[int]] = {}
    for k, (parameter, reference) in enumerate(zip(parameters, references, strict=True)):
        true = reference is not None and reference.is_true
        unit = parameter.unit if true and reference is not None and reference.value == 0.0 else "%"
        sets.setdefault((kind_of(parameter), unit, true), []).append(k)
    groups = []
    for (kind, unit, true), members in sets.items():
        # One name whether or not there is a truth, but two where only some have one.
        name = f"{kind}_own" if not true and (kind, "%", True) in sets else kind
        parts = np.array_split(np.array(members), -(-len(members) // MOST_LINES))
        for number, indices in enumerate(parts, start=1):
            which = f" ({number} of {len(parts)})" if len(parts) > 1 else ""
            path = re.sub(r"\W", "_", f"{name}_{unit}{which}").strip("_")
            labels = tuple(shortened(parameters[k].symbol) for k in indices)
            title, zero, half = f"{kind}{which}: estimate ± 2σ, {unit}", np.zeros(indices.size), None
            scale = np.ones(indices.size)
            if unit == "%":
                truth = [reference.value for k in indices if (reference := references[k]) is not None and true]
                zero = np.array(truth) if true else basis.about[indices]
                half = TRUE_RANGE if true else basis.half_range
                title = f"{kind}{which}: from the {'true value' if true else basis.name} ± 2σ, %"
                scale = np.abs(zero) / 100.0
            groups.append(Group(path, kind, title, indices, labels, zero, scale, unit, half))
    return groups


def shortened(symbol: str) -> str:
    """A symbol that fits beside a plot: of a combination what it begins with."""
    return symbol if len(symbol) <= LONGEST_LABEL else symbol[: LONGEST_LABEL - 1] + "…"


def kind_of(parameter: Parameter) -> str:
    """Kind of body, or effects, that a parameter belongs to."""
    if "@" in parameter.owner:
        return EFFECTS
    return KINDS.get(parameter.owner.split("_")[0], parameter.owner)
