"""comparison.html: each parameter over the sessions of a rig, with error bars, and what has changed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from sms_online.repeatability import Compared, Comparison, change_text
from sms_online.tables import formatter
from sms_tools.html_report.figures import BAND, HEIGHT, WIDTH, Chart, drawn, ink
from sms_tools.html_report.pages import write_page
from sms_tools.view.known import BOUNDS

NAME = "comparison.html"
# Of more sessions only some are named below a chart.
MOST_NAMES = 10


def write_comparison(directory: Path, comparison: Comparison) -> Path:
    """Write comparison.html; InputError where it cannot be written."""
    known = [each for each in comparison.parameters.values() if math.isfinite(each.reference)]
    # What has changed comes first.
    known.sort(key=lambda each: not each.changes)
    calibration = [each for each in comparison.calibration.values() if math.isfinite(each.reference)]
    return write_page(
        directory / NAME,
        "comparison.html",
        title=f"{comparison.system}: {len(comparison.sessions)} sessions",
        comparison=comparison,
        numbered=[(f"{k}", name) for k, name in enumerate(comparison.sessions, start=1)],
        rows=[_row(each) for each in known],
        charts=[_chart(each, comparison.sessions) for each in known],
        calibration=[_row(each) for each in calibration],
        calibration_charts=[_chart(each, comparison.sessions) for each in calibration],
    )


def _row(each: Compared) -> dict[str, object]:
    shown = formatter(each.reference, each.size)
    return {
        "name": each.name,
        "symbol": each.symbol,
        "unit": each.unit,
        "reference": shown(each.reference),
        "spread": f"{each.spread:.2g}" if each.spread else "",
        "percent": f"{100.0 * each.spread / abs(each.reference):.2g}" if each.spread and each.relative else "",
        "sessions": int(np.isfinite(each.values).sum()),
        "changes": [(c.session, change_text(c, each), f"{abs(c.deviations):.3g}") for c in each.changes],
    }


def _chart(each: Compared, sessions: Sequence[str]) -> Chart:
    """Deviation from the reference over the sessions, % of it; in the parameter's unit where that may be zero."""
    scale = abs(each.reference) / 100.0 if each.relative else 1.0
    unit = "%" if each.relative else each.unit
    number = np.arange(1, each.values.size + 1)
    off, bars = (each.values - each.reference) / scale, BOUNDS * each.stds / scale
    changed = np.isin(sessions, [change.session for change in each.changes])

    def draw(axes: Axes) -> None:
        for some, color in ((~changed, "blue"), (changed, "alarm")):
            axes.errorbar(number[some], off[some], bars[some], fmt="o", ms=4.0, color=ink(color))
        axes.axhline(0.0, color=ink("muted"), linewidth=1.0)
        if each.spread:
            limit = BOUNDS * each.spread / scale
            axes.axhspan(-limit, limit, color=ink("muted"), alpha=BAND, linewidth=0)
        axes.set_xlim(0.5, number.size + 0.5)
        axes.set_xticks(number if number.size <= MOST_NAMES else np.linspace(1, number.size, MOST_NAMES).round())
        axes.set_xlabel("session")

    shown = formatter(each.reference, each.size)(each.reference)
    caption = f"{each.name}, {unit} off {shown} {each.unit}".rstrip()
    return Chart(caption, (), drawn(each.name, WIDTH, HEIGHT, draw))
