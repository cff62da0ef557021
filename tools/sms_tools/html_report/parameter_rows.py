"""The table of parameters: estimates beside nominal and true values, with their error bars."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from sms_tools.report import Document, estimate_cells
from sms_tools.view.known import BOUNDS
from sms_tools.view.parameter_groups import half_range, shortened


@dataclass(frozen=True)
class Bar:
    """An error bar: where it begins and ends, and where the estimate is, % of its cell's width.

    color: its name. middle: none where the estimate is beyond the cell. below, above: whether the bar goes on beyond
    it.
    """

    start: float
    end: float
    middle: float | None
    color: str
    below: bool
    above: bool


def error_bar(deviation: float, bound: float, limit: float, color: str) -> Bar | None:
    """Deviation from a reference, and 2σ, on a scale of ± limit about it; none where one is not known."""
    if not np.isfinite((deviation, bound)).all():
        return None
    ends = np.array((deviation - bound, deviation + bound, deviation)) / limit
    start, end, middle = (50.0 + 50.0 * np.clip(ends, -1.0, 1.0)).round(1).tolist()
    seen = abs(deviation) <= limit
    return Bar(start, end, middle if seen else None, color, bool(ends[0] < -1.0), bool(ends[1] > 1.0))


def with_subscripts(symbol: str) -> Markup:
    """A parameter's symbol with its indices set low."""
    return Markup(re.sub("_([+-]?[0-9A-Za-z]+)", r"<sub>\1</sub>", str(escape(symbol))))


def breakable(name: str) -> Markup:
    """A parameter's name that may go on in the next line after its dot, its at, or a body that is lumped into it."""
    return Markup(re.sub("([.@]|_and_)", r"\1<wbr>", str(escape(name))))


def parameter_rows(results: Mapping[str, tuple[list[Document], str]], nominal: Mapping[str, float]) -> dict[str, Any]:
    """What the template of the table takes.

    results: of each column of estimates, by its heading, the parameters as in results.json and the bars' colour; the
    last one's parameters are the rows. Bars are about the true value where it is known, else about the last estimate.
    nominal: the system file's values by name, where it states them.
    """
    *_, (last, _) = results.values()
    is_true = any(p["true"] is not None for p in last)
    columns = [{p["name"]: p for p in parameters} for parameters, _ in results.values()]
    rows: list[dict[str, Any]] = []
    drawn = np.full((len(last), len(columns), 2), np.nan)  # estimate from the middle of the bars, and 2σ, %
    for k, p in enumerate(last):
        own = [column.get(p["name"]) for column in columns]
        stated = nominal.get(p["name"])
        middle = p["true"] if is_true else p["estimate"] if p["identifiable"] else None
        for j, each in enumerate(own):
            if each is not None and each["identifiable"] and middle:
                drawn[k, j] = np.array((each["estimate"] - middle, BOUNDS * each["std"])) * 100.0 / abs(middle)
        rows.append(
            p
            | {
                "short": shortened(p["symbol"]),
                "estimates": [("", "", "") if each is None else estimate_cells(each) for each in own],
                "nominal": "" if stated is None else f"{stated:.6g}",
                "true": "" if p["true"] is None else f"{p['true']:.6g}",
                "deviation": _deviation(own, p["true"] if is_true else stated),
            }
        )
    limit = half_range(np.abs(drawn).sum(axis=2).ravel())
    for row, bars in zip(rows, drawn.tolist(), strict=True):
        row["bars"] = [
            # Where a single estimate's bounds do not hold what it is compared with, it is an alarm.
            error_bar(off, bound, limit, "alarm" if len(columns) == 1 and abs(off) > bound else color)
            for (off, bound), (_, color) in zip(bars, results.values(), strict=True)
        ]
    return {"rows": rows, "columns": list(results), "is_true": is_true, "limit": f"{limit:g}"}


def _deviation(estimates: Sequence[Document | None], value: float | None) -> str:
    """Deviations of estimates from a value other than zero, %, one after the other."""
    known = [p["estimate"] if p is not None and p["identifiable"] else None for p in estimates]
    if not value or not any(known):
        return ""
    return " → ".join("–" if each is None else f"{100.0 * (each - value) / abs(value):+.2g}" for each in known)
