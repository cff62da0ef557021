"""report.html: parameters with error bars, how they converged, residuals, the arm, conditions and warnings."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array
from sms_tools.html_report.arm_drawing import arm_drawings
from sms_tools.html_report.error_bars import Bar, error_bars
from sms_tools.html_report.history import History
from sms_tools.html_report.svg import Series, chart
from sms_tools.report import NOT_DETERMINED, Document, formatter, trust_lines
from sms_tools.view.frames import Reference
from sms_tools.view.known import BOUNDS
from sms_tools.view.parameter_groups import HALF_RANGES, Basis, Group, half_range, parameter_groups, shortened
from sms_tools.view.scene import Scene

NAME = "report.html"
# Pictures of the arm: at the start, at the end, and evenly between.
PICTURES = 5
# Candidates in a chart: more lines than that nobody tells apart.
MOST_CANDIDATES = 6

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #1c2733; max-width: 1160px; margin: 2em auto; padding: 0 1em }
h1 { font-size: 1.5em; margin-bottom: 0.1em } h2 { font-size: 1.15em; margin-top: 1.8em }
table { border-collapse: collapse; display: block; overflow-x: auto }
td, th { padding: 0.15em 0.6em; text-align: right; white-space: nowrap; border-bottom: 1px solid #e4e9ee }
td:first-child, th:first-child, .left { text-align: left } tr.unknown { color: #8895a3 }
figure { display: inline-block; margin: 0.3em; text-align: center } figcaption { font-size: 0.85em; color: #5a6875 }
svg { background: #fff; max-width: 100%; height: auto } svg text { font: 11px system-ui, sans-serif; fill: #5a6875 }
svg .title { font-size: 13px; fill: #1c2733 } svg .legend { text-anchor: end; paint-order: stroke; stroke: #fff;
stroke-width: 3px } .grid { stroke: #e8edf2 } .span { fill: #f1f4f7 } .mark { stroke: #d04040; stroke-dasharray: 3 3 }
.judgement { color: #fff; border-radius: 6px; padding: 0.7em 1.1em; margin-bottom: 1.2em }
.judgement b { font-size: 1.3em } .judgement ul { margin: 0.4em 0 0; padding-left: 1.3em }
.trust { background: #1e8449 } .doubt { background: #f0a41c; color: #1c2733 } .grave { background: #c0282d }
.not_yet { background: #6d747d }
.warning { background: #fff4e0; border-left: 4px solid #e0a030; padding: 0.3em 0.8em; margin: 0.4em 0 }
.verdict { font-size: 1.1em; border-left: 6px solid #b4005a; background: #f8f1f5; padding: 0.5em 0.9em }
.verdict.clean { border-color: #009e73; background: #eff8f5 }
.pair { display: flex; flex-wrap: wrap; gap: 1.5em; align-items: center }
svg .badge { fill: #fff; text-anchor: middle; font-weight: bold }
th.over { text-align: center } .dense { font-size: 13px }
td.beyond { color: #c04000; font-weight: bold }
pre { background: #f1f4f7; padding: 0.6em 0.9em; font-size: 13px; overflow-x: auto }
"""


def write_report(
    directory: Path,
    document: Document,
    estimator: Estimator,
    history: History,
    references: Sequence[Reference | None],
    exaggeration: float = 1.0,
) -> Path:
    """Write report.html of a finished session beside its results.

    document: its results. references: what each parameter is compared with. exaggeration: factor on drawn deflections.
    Raises InputError where the file cannot be written.
    """
    system = document["system"]
    sections = [
        verdict_box(document["verdict"]),
        f"<h1>{escape(system['title'] or system['name'])}</h1><p>{escape(system['reference'])}</p>",
        *(f'<p class="warning">{escape(warning)}</p>' for warning in document["warnings"]),
        "<h2>Parameters</h2>",
        _parameters(document, references),
        "<h2>Convergence</h2>",
        *_convergence(estimator, history, references),
        "<h2>Residual</h2>",
        *_residual(document, history),
        *_diagnosis(document),
        "<h2>The arm</h2>",
        *_arm(Scene(estimator.model, exaggeration), history),
        "<h2>Conditions</h2><ul>",
        *(f"<li>{escape(line)}</li>" for line in trust_lines(document) if not line.startswith(("residual", "warning"))),
        "</ul>",
    ]
    return write_page(directory / NAME, f"{system['name']}: parameters", "\n".join(sections))


def verdict_box(verdict: Document) -> str:
    """Whether to trust the numbers, in its colour, and the reasons."""
    kind = "grave" if verdict["grave"] else verdict["level"].replace(" ", "_")
    others = "".join(f"<li>{escape(reason)}</li>" for reason in verdict["reasons"][1:])
    listed = f"<ul>{others}</ul>" if others else ""
    return f'<div class="judgement {kind}"><b>{escape(verdict["sentence"])}</b>{listed}</div>'


def write_page(path: Path, title: str, body: str) -> Path:
    """A self-contained page; InputError where it cannot be written."""
    text = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise InputError(str(path), "", error.strerror or str(error), "a file that can be written") from None
    return path


def _parameters(document: Document, references: Sequence[Reference | None]) -> str:
    """The table, each parameter with its error bar about the true value, or where none is known about the estimate."""
    parameters = document["parameters"]
    deviations, drawn = np.full((2, len(parameters), 2), np.nan)  # of the estimate from something, and 2σ, in % of that
    is_true = False
    for k, (p, reference) in enumerate(zip(parameters, references, strict=True)):
        is_true |= reference is not None and reference.is_true
        if p["identifiable"]:
            if reference is not None and reference.value:
                deviations[k] = _relative(p, reference.value)
            drawn[k] = deviations[k] if reference is not None and reference.is_true else _relative(p, p["estimate"])
    limit = half_range(np.abs(drawn).sum(axis=1))
    compared = "true" if is_true else "nominal"
    rows = [
        '<table class="dense"><tr><th>parameter</th><th></th><th>unit</th><th>estimate</th><th>± std</th>'
        f"<th>95 % interval</th><th>{compared}</th><th>deviation %</th><th>± 2σ, axis ± {limit:g} %</th></tr>"
    ]
    for p, reference, (deviation, _), bar in zip(parameters, references, deviations, drawn, strict=True):
        known = "" if reference is None else f"{reference.value:.6g}"
        if p["identifiable"]:
            percent = f"{deviation:+.3g}" if np.isfinite(deviation) else ""
            shown = formatter(p["estimate"], p["std"])
            numbers = [shown(p["estimate"]), f"{p['std']:.2g}", f"{shown(p['lower95'])} … {shown(p['upper95'])}"]
            cells = [*numbers, known, percent, _bar(float(bar[0]), float(bar[1]), limit)]
        else:
            cells = [NOT_DETERMINED, "", "", known, "", ""]
        symbol = escape(shortened(p["symbol"]))
        start = f'<td>{escape(p["name"])}</td><td class="left">{symbol}</td><td>{escape(p["unit"])}</td>'
        kind = "" if p["identifiable"] else ' class="unknown"'
        rows.append(f"<tr{kind}>{start}{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    return "\n".join([*rows, "</table>"])


def _relative(p: Document, value: float) -> tuple[float, float]:
    """Deviation of an estimate from a value, and 2σ, % of it."""
    size = abs(value) / 100.0
    return (p["estimate"] - value) / size, BOUNDS * p["std"] / size


def _bar(deviation: float, bound: float, limit: float) -> str:
    """Estimate and ± 2σ on a scale of ± limit %; red where what is in the middle lies outside the bounds."""
    return error_bars([Bar(deviation, bound, "#0072b2" if abs(deviation) <= bound else "#d04040")], limit)


def _convergence(estimator: Estimator, history: History, references: Sequence[Reference | None]) -> list[str]:
    instants = history.instants
    if not instants:
        return ["<p>No samples.</p>"]
    t = np.array([instant.t for instant in instants])
    estimate, std = np.full((2, len(instants), estimator.base.n), np.nan)
    for k, instant in enumerate(instants):
        # Fewer before an event has added some.
        known = np.flatnonzero(instant.determined)
        estimate[k, known], std[k, known] = instant.estimate[known], instant.std[known]
    marks = [event.time for event in estimator.events]
    curves = []
    last = instants[-1]
    basis = Basis(np.where(last.determined, last.estimate, np.nan), "last estimate", HALF_RANGES[-1])
    for group in parameter_groups(estimator.base.parameters, references, basis):
        drawn = (estimate[:, group.indices] - group.zero) / group.scale
        curves.append((group, drawn, BOUNDS * std[:, group.indices] / group.scale))
    # One axis for all deviations, which holds what was known at half time and at the end: between them they settle.
    half = len(instants) // 2
    reach = [np.abs(drawn) + width for group, drawn, width in curves if group.half_range is not None]
    limit = max(half_range(np.concatenate([r[k] for r in reach])) for k in (half, -1)) if reach else np.nan
    return [_group_chart(group, t, drawn, width, limit, marks) for group, drawn, width in curves]


def _group_chart(group: Group, t: Array, drawn: Array, width: Array, limit: float, marks: Sequence[float]) -> str:
    series = [
        Series(label, drawn[:, k], drawn[:, k] - width[:, k], drawn[:, k] + width[:, k])
        for k, label in enumerate(group.labels)
    ]
    y_range = None if group.half_range is None else (-limit, limit)
    return chart(group.title, t, series, "time, s", y_range, marks)


def _residual(document: Document, history: History) -> list[str]:
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{_number(residual['relative'])}</td><td>{_number(residual['whitened'])}</td></tr>"
        for name, residual in document["residual"].items()
        if any(value is not None for value in residual.values())
    )
    heading = "<tr><th>rows</th><th>share of torque or force</th><th>whitened, 1 is noise</th></tr>"
    parts = [f"<table>{heading}{rows}</table>"]
    if history.instants:
        t = np.array([instant.t for instant in history.instants])
        relative = np.array([instant.residual for instant in history.instants])
        series = [Series(f"joint {i + 1}", relative[:, i]) for i in range(relative.shape[1])]
        parts.append(chart("Unexplained torque or force, share", t, series, "time, s", (0.0, 1.0)))
    return parts


def _diagnosis(document: Document) -> list[str]:
    """What was noticed and named on the way, with the evidence as it grew."""
    episodes = document.get("diagnosis", [])
    parts = ["<h2>Diagnosis</h2>"] if episodes else []
    for episode in episodes:
        parts.append(f'<p class="verdict">{escape(episode["summary"])}</p>')
        searches = episode["evidence"]
        if len(searches) > 1:
            t = np.array([each["time"] for each in searches])
            names = list(dict.fromkeys(name for each in searches for name in each["candidates"]))[:MOST_CANDIDATES]
            gains = np.array([[each["candidates"].get(name, np.nan) for name in names] for each in searches])
            series = [
                Series(name, column) for name, column in zip(names, np.log10(np.maximum(gains, 1.0)).T, strict=True)
            ]
            parts.append(chart("Evidence for candidates, log10 of the gain", t, series, "time of the newest sample, s"))
    return parts


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _arm(scene: Scene, history: History) -> list[str]:
    seen = [instant for instant in history.instants if np.isfinite(instant.x).all()]
    if not seen:
        return ["<p>Never seen whole: some channel has no reading.</p>"]
    chosen = np.unique(np.linspace(0, len(seen) - 1, PICTURES).round().astype(int)).tolist()
    captions = [f"{seen[k].t:.2f} s" for k in chosen]
    view = "from above" if scene.model.layout.planar else "from one side"
    factor = f"; deflections × {scene.exaggeration:g}" if scene.exaggeration != 1.0 else ""
    explained = f"Seen {view}{factor}. Grey: the same motor angles if the arm were rigid. Blue: where the tip has been."
    return [f"<p>{explained}</p>", *arm_drawings(scene, np.array([i.x for i in seen]), chosen, captions)]
