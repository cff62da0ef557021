"""Charts of a diagnosis: residual before and after over time, and what it was against the law that explains it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.diagnosis.attempt import State
from sms_online.diagnosis.diagnose import Diagnosis
from sms_online.diagnosis.force_curves import AddedVariable, ForceCurve, added_variables, force_curves
from sms_online.diagnosis.weak_windows import Windows
from sms_online.row_types import row_types
from sms_online.stream import Array
from sms_tools.html_report.svg import Series, chart
from sms_tools.view.known import BOUNDS

BEFORE, AFTER, NOISE, LAW = "#d55e00", "#0072b2", "#7a8794", "#1c2733"
# Half range of a residual drawn to see noise, in standard deviations.
CLOSE_UP = 5.0
# Of the residuals drawn close up so many stay inside where noise is left far behind.
SHOWN = 0.99
# What is held out of another capture is drawn so far behind what was fitted, as a share of the latter.
PAUSE = 0.02
# Room above lines for two lines of legend, as a share of their range.
LEGEND_ROOM = 0.3


def residual_charts(diagnosis: Diagnosis) -> list[str]:
    """Of each row type the coordinate that was furthest off, before and after; noise close up where it was far off."""
    before, after = diagnosis.before, diagnosis.after
    rows, rows_after = diagnosis.described.rows, diagnosis.attempt.rows
    names, names_after = (each.model.layout.speed_names for each in (rows, rows_after))
    types_after = row_types(rows_after.model.layout)
    (t, held), (t_after, _) = _time(before), _time(after)
    out = []
    for row, speeds in row_types(rows.model.layout).items():
        worst = _worst(before, speeds)
        name = names[worst]
        lines = [_noise(t), _residual(before, rows.weak.windows, t, worst, BEFORE)]
        if after.system != before.system:
            # Exact links have coordinates of their own.
            same = names_after.index(name) if name in names_after else _worst(after, types_after[row])
            lines.append(_residual(after, rows_after.weak.windows, t_after, same, AFTER))
        out.append(chart(f"{row} ({name}): residual over its deviation", t, lines, "time, s", shaded=held))
        if len(lines) > 2 and before.test[row].beyond:
            half = max(CLOSE_UP, float(np.quantile(np.abs(lines[2].y[np.isfinite(lines[2].y)]), SHOWN)))
            title = f"{row} ({names_after[same]}), close up: what is left after"
            out.append(chart(title, t, [lines[0], lines[2]], "time, s", (-half, half), shaded=held))
    return out


def _worst(state: State, speeds: Sequence[int]) -> int:
    return max(speeds, key=lambda k: float(np.sum(state.residual[:, k] ** 2)))


def _time(state: State) -> tuple[Array, list[tuple[float, float]]]:
    """Times (W,) of windows and spans that are held out; what another capture holds is drawn behind the first."""
    t, held = state.time.copy(), ~state.fitted
    first = t[state.fitted]
    if held.any() and first.size and t[held].min() < first.max():
        t[held] += first.max() * (1.0 + PAUSE) - t[held].min()
    return t, [(float(t[held].min()), float(t[held].max()))] if held.any() else []


def _noise(t: Array) -> Series:
    ends = np.array((t.min(), t.max()))
    bound = np.full(2, BOUNDS)
    return Series("", np.zeros(2), -bound, bound, True, ends, NOISE)


def _residual(state: State, windows: Windows, t: Array, speed: int, color: str) -> Series:
    """A line that is interrupted between stretches of the session."""
    starts = np.flatnonzero(np.diff(windows.segment)) + 1
    y = np.insert(state.residual[:, speed], starts, np.nan)
    return Series("", y, x=np.insert(t, starts, t[starts]), color=color)


def law_charts(diagnosis: Diagnosis) -> list[str]:
    """Of each effect found the force that the data show over what it depends on, or its rows, beside the law."""
    charts = [_curve_chart(curve) for curve in force_curves(diagnosis)]
    charts += [_added_chart(added) for added in added_variables(diagnosis)]
    found = diagnosis.unexplained
    if found is not None:
        title = f"{found.speed}: force that stands in for what is not known"
        charts.append(chart(title, found.at, [Series("spline", found.force, color=BEFORE)], found.variable))
    return charts


def _curve_chart(curve: ForceCurve) -> str:
    bound = BOUNDS * curve.std
    names = " + ".join(effect.name for effect in curve.effects)
    series = [
        Series("from the data ± 2σ", curve.force, curve.force - bound, curve.force + bound, color=BEFORE),
        Series(f"law: {names}", curve.law, dashed=True, color=LAW),
    ]
    title = f"{curve.where}: force that the model lacks, {curve.force_unit}"
    return chart(title, curve.at, series, f"{curve.variable}, {curve.unit}", _with_room(curve.force, curve.law))


def _with_room(*lines: Array) -> tuple[float, float]:
    """A range of all lines with room above them for a legend."""
    values = np.concatenate(lines)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    size = high - low or abs(high) or 1.0
    return low - 0.1 * size, high + LEGEND_ROOM * size


def _added_chart(added: AddedVariable) -> str:
    bound = BOUNDS * added.std
    series = [
        Series("left without it ± 2σ", added.left, added.left - bound, added.left + bound, color=BEFORE),
        Series("as it says", added.expected, dashed=True, color=LAW),
    ]
    title = f"{added.effect.name} at {added.effect.where}: rows over their deviation"
    return chart(
        title,
        added.expected,
        series,
        "what the effect adds to a row, over its deviation",
        _with_room(added.left, added.expected),
    )
