"""Which parameters share a plot: those of one kind of body, as deviations where a reference is known, else by unit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_online.model.parameters import Parameter
from sms_tools.view.frames import Reference

# Lines that a person can tell apart in one plot.
MOST_LINES = 6
# Longest label, characters.
LONGEST_LABEL = 18
KINDS = {"spacecraft": "spacecraft", "joint": "joints", "motor": "motors", "link": "links", "payload": "payload"}
EFFECTS = "effects"
# Half width of a plot of deviations, %: around true values estimates come close, around nominal ones who knows.
TRUE_RANGE, NOMINAL_RANGE = 0.2, 100.0


@dataclass(frozen=True)
class Group:
    """Parameters (by index) of one plot.

    path: entity. scale: what an estimate is divided by after its reference is subtracted. unit: of the plot, `%` for
    deviations. half_range: of the plot's axis, None where nothing tells.
    """

    path: str
    kind: str
    title: str
    indices: NDArray[np.int64]
    labels: tuple[str, ...]
    zero: NDArray[np.float64]
    scale: NDArray[np.float64]
    unit: str
    half_range: float | None


def parameter_groups(parameters: Sequence[Parameter], references: Sequence[Reference | None]) -> list[Group]:
    """Groups of the base parameters, in their order."""
    sets: dict[tuple[str, str], list[int]] = {}
    for k, (parameter, reference) in enumerate(zip(parameters, references, strict=True)):
        unit = "%" if reference is not None and reference.value != 0.0 else parameter.unit
        sets.setdefault((_kind(parameter), unit), []).append(k)
    groups = []
    for (kind, unit), members in sets.items():
        parts = np.array_split(np.array(members), -(-len(members) // MOST_LINES))
        for number, indices in enumerate(parts, start=1):
            which = f" ({number} of {len(parts)})" if len(parts) > 1 else ""
            groups.append(_group(kind, unit, which, indices, parameters, references))
    return groups


def shortened(symbol: str) -> str:
    """A symbol that fits beside a plot: of a combination what it begins with."""
    return symbol if len(symbol) <= LONGEST_LABEL else symbol[: LONGEST_LABEL - 1] + "…"


def _group(
    kind: str,
    unit: str,
    which: str,
    indices: NDArray[np.int64],
    parameters: Sequence[Parameter],
    references: Sequence[Reference | None],
) -> Group:
    zero, scale = np.zeros(indices.size), np.ones(indices.size)
    labels = tuple(shortened(parameters[k].symbol) for k in indices)
    half_range = None
    title = f"{kind}{which}: estimate ± 2σ, {unit}"
    if unit == "%":
        found = [reference for k in indices if (reference := references[k]) is not None]
        zero = np.array([reference.value for reference in found])
        scale = np.abs(zero) / 100.0
        half_range = TRUE_RANGE if all(reference.is_true for reference in found) else NOMINAL_RANGE
        compared = "true" if half_range == TRUE_RANGE else "nominal"
        title = f"{kind}{which}: ± 2σ from the {compared} value, %"
    path = re.sub(r"\W", "_", f"{kind}_{unit}{which}").strip("_")
    return Group(path, kind, title, indices, labels, zero, scale, unit, half_range)


def _kind(parameter: Parameter) -> str:
    if "@" in parameter.owner:
        return EFFECTS
    return KINDS.get(parameter.owner.split("_")[0], parameter.owner)
