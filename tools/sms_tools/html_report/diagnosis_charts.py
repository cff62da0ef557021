"""Charts of a diagnosis: residual over time before and after, and force against the law that explains it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.diagnosis.attempt import ModelFit
from sms_online.diagnosis.force_curves import AddedVariable, ForceCurve, added_variables, force_curves
from sms_online.diagnosis.search import Search
from sms_online.diagnosis.weak_windows import WindowPlaces
from sms_online.row_types import row_types
from sms_online.stream import Array
from sms_tools.html_report.figures import Chart, Series, chart
from sms_tools.view.known import BOUNDS

BEFORE, AFTER, NOISE, LAW = "orange", "blue", "grey", "ink"
# Half range of a residual drawn to see noise, in standard deviations.
CLOSE_UP = 5.0
# Of the residuals drawn close up so many stay inside where noise is left far behind.
SHOWN = 0.99
TIME = "time, s"


def residual_charts(diagnosis: Search) -> list[Chart]:
    """Charts of each row type's worst coordinate, before and after; noise close up where it was far off."""
    before, after = diagnosis.before, diagnosis.after
    rows, rows_after = diagnosis.described.rows, diagnosis.attempt.rows
    names, names_after = (each.model.layout.speed_names for each in (rows, rows_after))
    types_after = row_types(rows_after.model.layout)
    t, t_after = before.time, after.time
    out = []
    for row, speeds in row_types(rows.model.layout).items():
        worst = _worst(before, speeds)
        name = names[worst]
        changed = after.system != before.system
        noise, line = _noise(t), _residual(before, rows.weak.windows, t, worst, BEFORE if changed else AFTER)
        if not changed:
            out.append(chart(f"{row}, {name}", [noise, line], TIME))
            continue
        # Exact links have coordinates of their own.
        same = names_after.index(name) if name in names_after else _worst(after, types_after[row])
        line_after = _residual(after, rows_after.weak.windows, t_after, same, AFTER)
        out.append(chart(f"{row}, {name}", [noise, line, line_after], TIME))
        if before.test[row].beyond:
            half = max(CLOSE_UP, float(np.quantile(np.abs(line_after.y[np.isfinite(line_after.y)]), SHOWN)))
            caption = f"{row}, {names_after[same]}, close up"
            out.append(chart(caption, [noise, line_after], TIME, (-half, half)))
    return out


def _worst(state: ModelFit, speeds: Sequence[int]) -> int:
    return max(speeds, key=lambda k: float(np.sum(state.residual[:, k] ** 2)))


def _noise(t: Array) -> Series:
    bound = np.full(2, BOUNDS)
    return Series("", np.array((t.min(), t.max())), np.zeros(2), -bound, bound, True, NOISE)


def _residual(state: ModelFit, windows: WindowPlaces, t: Array, speed: int, color: str) -> Series:
    """A line that is interrupted between stretches of the session."""
    starts = np.flatnonzero(np.diff(windows.segment)) + 1
    y = np.insert(state.residual[:, speed], starts, np.nan)
    return Series("", np.insert(t, starts, t[starts]), y, color=color)


def law_charts(diagnosis: Search) -> list[Chart]:
    """Charts of each effect found: the force in the data over what it depends on, or its rows, beside the law."""
    charts = [_curve_chart(curve) for curve in force_curves(diagnosis)]
    charts += [_added_chart(added) for added in added_variables(diagnosis)]
    found = diagnosis.unexplained
    if found is not None:
        line = Series("spline", found.at, found.force, color=BEFORE)
        charts.append(chart(f"{found.speed}: force in place of what is unknown", [line], found.variable))
    return charts


def _curve_chart(curve: ForceCurve) -> Chart:
    bound = BOUNDS * curve.std
    names = " + ".join(effect.name for effect in curve.effects)
    lines = [
        Series("from the data ± 2σ", curve.at, curve.force, curve.force - bound, curve.force + bound, color=BEFORE),
        Series(f"law: {names}", curve.at, curve.law, dashed=True, color=LAW),
    ]
    caption = f"{curve.where}: force that the model lacks, {curve.force_unit}, over {curve.variable}"
    return chart(caption, lines, f"{curve.variable}, {curve.unit}")


def _added_chart(added: AddedVariable) -> Chart:
    at, left, bound = added.expected, added.left, BOUNDS * added.std
    lines = [
        Series("residual without it ± 2σ", at, left, left - bound, left + bound, color=BEFORE),
        Series("expected", at, at, dashed=True, color=LAW),
    ]
    caption = f"{added.effect.name} at {added.effect.where}: whitened rows without it"
    return chart(caption, lines, "what the effect adds to a row, over its deviation")
