"""Parameters that moved in a session: what each tracker made of them over time."""

from __future__ import annotations

import numpy as np

from sms_online.stream import Array
from sms_tools.html_report.figures import LINES, Chart, Series, chart
from sms_tools.report import Document
from sms_tools.view.known import BOUNDS

# Estimates of a parameter that stays differ by less than so many standard deviations, also the furthest two of many.
STEADY = 5.0
# Share of the instants, the first ones, that are no sign of a move, and that no axis has to hold.
TRANSIENT = 0.25
# Charts, at most: those of what moved furthest.
MOST_CHARTS = 9
# Room above and below what an axis holds, as a share of it.
MARGIN = 0.08


def moved_charts(document: Document) -> list[Chart]:
    """A chart for each parameter that has moved: value ± 2σ, a colour for each tracker.

    It has moved where a tracker has found a drift, or where its judged estimates are far apart: other estimates may
    wander because another parameter drifts.
    """
    histories = document.get("history", [])
    if not histories or len(histories[0]["t"]) < 2:
        return []
    drifting = drifting_parameters(document)
    (judged,) = (history for history in histories if history["judged"])
    far = {}
    for p in document["parameters"]:
        furthest = _furthest(*estimates(judged, p["name"]))
        if p["name"] in drifting or furthest > STEADY:
            far[p["name"]] = (p["name"] in drifting, furthest)
    chosen = sorted(far, key=lambda name: far[name], reverse=True)[:MOST_CHARTS]
    marks = [event["time"] for event in document["events"]]
    return [_chart(p, histories, marks) for p in document["parameters"] if p["name"] in chosen]


def drifting_parameters(document: Document) -> set[str]:
    """Names of the parameters that a tracker has found to drift."""
    return {drift["parameter"] for tracker in document.get("trackers", []) for drift in tracker["drifts"]}


def estimates(history: Document, name: str) -> tuple[Array, Array]:
    """Estimate and standard deviation (N,) of a parameter, NaN where there is none."""
    (found,) = (p for p in history["parameters"] if p["name"] == name)
    return np.array(found["estimate"], dtype=float), np.array(found["std"], dtype=float)


def _furthest(estimate: Array, std: Array) -> float:
    """How far two estimates behind the transient are apart, in standard deviations of their difference."""
    late = np.arange(estimate.size) >= TRANSIENT * estimate.size
    estimate, variance = estimate[late & np.isfinite(std)], std[late & np.isfinite(std)] ** 2
    if not estimate.size:
        return 0.0
    apart = np.abs(estimate[:, None] - estimate)
    deviation = np.sqrt(variance[:, None] + variance)
    return float(np.max(np.divide(apart, deviation, out=np.zeros_like(apart), where=deviation > 0.0)))


def _chart(p: Document, histories: list[Document], marks: list[float]) -> Chart:
    series, held = [], []
    for k, history in enumerate(histories):
        t, (estimate, std) = np.array(history["t"]), estimates(history, p["name"])
        color = LINES[k % len(LINES)]
        lower, upper = estimate - BOUNDS * std, estimate + BOUNDS * std
        label = history["tracker"] + (", judged" if history["judged"] and len(histories) > 1 else "")
        series.append(Series(label, t, estimate, lower, upper, color=color))
        late = np.arange(t.size) >= TRANSIENT * t.size
        held += [estimate[late], *((lower[late], upper[late]) if history["judged"] else ())]
    ends = np.concatenate(held)
    low, high = float(np.nanmin(ends)), float(np.nanmax(ends))
    room = MARGIN * (high - low)
    return chart(f"{p['name']} ± 2σ, {p['unit']}".rstrip(", "), series, "time, s", (low - room, high + room), marks)
