"""report.html: parameters with error bars, how they converged, residuals, the arm, conditions and warnings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sms_online.evaluation import identifiable
from sms_online.model.parameters import Parameter
from sms_tools.html_report.arm_drawing import arm_drawings
from sms_tools.html_report.course import Course
from sms_tools.html_report.figures import Chart, Series, chart
from sms_tools.html_report.moved import drifting_parameters, estimates, moved_charts
from sms_tools.html_report.pages import write_page
from sms_tools.html_report.parameter_rows import parameter_rows, with_subscripts
from sms_tools.report import METHODS, Document, drift_lines, event_line, tracker_facts, value_cell
from sms_tools.view.frames import Reference
from sms_tools.view.known import BOUNDS
from sms_tools.view.parameter_groups import HALF_RANGES, Basis, half_range, parameter_groups
from sms_tools.view.scene import Scene

NAME = "report.html"
# Pictures of the arm: at the start, at the end, and evenly between.
PICTURES = 6
# Candidates in a chart: more lines than that nobody keeps apart.
MOST_CANDIDATES = 6


def write_report(
    directory: Path, document: Document, course: Course, nominal: Mapping[str, float], scene: Scene
) -> Path:
    """Write report.html of a finished session beside its results.

    document: its results. nominal: the system file's values by name of the parameter, where it states them. Raises
    InputError where the file cannot be written.
    """
    return write_page(
        directory / NAME,
        "report.html",
        title=f"{document['system']['name']}: parameters",
        document=document,
        facts=_facts(document),
        events=[*map(event_line, document["events"]), *drift_lines(document)],
        parameters=parameter_rows({"estimate": (document["parameters"], "blue")}, nominal),
        trackers=_trackers(document),
        moved=moved_charts(document),
        convergence=_convergence(document, nominal),
        residual=_residual(course),
        episodes=[(episode["summary"], _evidence(episode)) for episode in document.get("diagnosis", [])],
        view="from above" if scene.model.layout.planar else "from one side",
        exaggeration=scene.exaggeration,
        arm=_arm(scene, course),
    )


def _trackers(document: Document) -> list[list[str]]:
    """Where there are several, a row of their names, then of each parameter's values, then of what they rest on."""
    trackers = document.get("trackers", [])
    if len(trackers) < 2:
        return []
    columns = zip(*(tracker["parameters"] for tracker in trackers), strict=True)
    values = [[row[0]["name"], *map(value_cell, row)] for row in columns]
    facts = [[heading, *cells] for heading, cells in tracker_facts(trackers).items()]
    return [["parameter", *(tracker["name"] for tracker in trackers)], *values, *facts]


def _facts(document: Document) -> dict[str, str]:
    condition = document["condition_number"]
    return {
        "method": METHODS[document["method"]],
        "duration": f"{document['duration_s']:.6g} s",
        "samples": f"{document['samples']:,}",
        "lost samples": str(document["lost_samples"]),
        "condition number": "infinite" if condition is None else f"{condition:.3g}",
    }


def _convergence(document: Document, nominal: Mapping[str, float]) -> list[Chart]:
    judged = next((each for each in document.get("history", []) if each["judged"]), None)
    if judged is None:
        return []
    # What drifts has a chart of its own: it converges to nothing.
    drifting, t = drifting_parameters(document), np.array(judged["t"])
    described = [p for p in document["parameters"] if p["name"] not in drifting]
    if not described:
        return []
    columns = zip(*(estimates(judged, p["name"]) for p in described), strict=True)
    estimate, std = map(np.column_stack, columns)
    estimate[~identifiable(estimate, std)] = np.nan
    parameters = [Parameter(p["name"], p["symbol"], p["unit"], nominal.get(p["name"], 0.0)) for p in described]
    references = [None if p["true"] is None else Reference(p["true"], True) for p in described]
    curves = []
    basis = Basis(estimate[-1], "last estimate", HALF_RANGES[-1])
    for group in parameter_groups(parameters, references, basis):
        drawn = (estimate[:, group.indices] - group.zero) / group.scale
        curves.append((group, drawn, BOUNDS * std[:, group.indices] / group.scale))
    # One axis for all deviations, which holds what was known at half time, since something was, and at the end: between
    # them they converge.
    reach = [np.abs(drawn) + width for group, drawn, width in curves if group.half_range is not None]
    known = np.flatnonzero(np.any([np.isfinite(r).any(axis=1) for r in reach], axis=0)) if reach else np.empty(0, int)
    half = known[known.size // 2] if known.size else -1
    limit = max(half_range(np.concatenate([r[k] for r in reach])) for k in (half, -1)) if reach else np.nan
    marks = [event["time"] for event in document["events"]]
    charts = []
    for group, drawn, width in curves:
        series = [
            Series(with_subscripts(label), t, y, y - bound, y + bound)
            for label, y, bound in zip(group.labels, drawn.T, width.T, strict=True)
            if np.isfinite(y[-1])
        ]
        y_range = None if group.half_range is None else (-limit, limit)
        if series:
            charts.append(chart(group.title, series, "time, s", y_range, marks))
    return charts


def _residual(course: Course) -> list[Chart]:
    joints = enumerate(course.residual.T, start=1)
    # One instant, of a short session, is no line; the table says it.
    series = [Series(f"joint {i}", course.tested, share) for i, share in joints if np.isfinite(share).sum() > 1]
    caption = "Unexplained share of the torque or force, over the last second"
    return [chart(caption, series, "time, s", log=True)] if series else []


def _evidence(episode: Document) -> list[Chart]:
    """How the evidence for what was found grew."""
    searches = episode["evidence"]
    if len(searches) < 2:
        return []
    t = np.array([each["time"] for each in searches])
    names = list(dict.fromkeys(name for each in searches for name in each["candidates"]))[:MOST_CANDIDATES]
    gains = np.array([[each["candidates"].get(name, np.nan) for name in names] for each in searches])
    series = [Series(name, t, column) for name, column in zip(names, np.maximum(gains, 1.0).T, strict=True)]
    caption = f"Evidence for candidates until {t[-1]:.4g} s: gain in the whitened sum of squares"
    return [chart(caption, series, "time of the newest sample, s", log=True)]


def _arm(scene: Scene, course: Course) -> list[Chart]:
    if not course.seen.size:
        return []
    chosen = np.unique(np.linspace(0, course.seen.size - 1, PICTURES).round().astype(int)).tolist()
    return arm_drawings(scene, course.x, chosen, [f"{course.seen[k]:.2f} s" for k in chosen])
