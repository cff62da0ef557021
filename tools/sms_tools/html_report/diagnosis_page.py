"""diagnosis.html: what the model lacks, where, how that is known, and what adding it changes."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from sms_online.diagnosis.diagnose import Diagnosis
from sms_tools.html_report.arm_drawing import marked_arm
from sms_tools.html_report.diagnosis_charts import AFTER, BEFORE, law_charts, residual_charts
from sms_tools.html_report.error_bars import Bar, error_bars
from sms_tools.html_report.page import verdict_box, write_page
from sms_tools.html_report.svg import svg
from sms_tools.report import NOT_DETERMINED, Document, formatter
from sms_tools.view.known import BOUNDS
from sms_tools.view.parameter_groups import half_range
from sms_tools.view.places import places_of
from sms_tools.view.scene import Scene

NAME = "diagnosis.html"
# Candidates that are listed, and look-alikes that are named beside an effect.
LISTED, LOOK_ALIKES = 12, 8
# Bar of a share of one, px.
SHARE_WIDTH, SHARE_HEIGHT = 220, 14
FOUND, LIKE, OTHER = "#b4005a", "#e3a6c6", "#c9d2dc"
# Positions that the tip's way is drawn through.
WAY_POINTS = 300

HOW_LAWS = (
    "Where an effect is a force over one variable, that force is also fitted as a free curve, with everything else as "
    "found: where the curve leaves the law by more than its band, the law is not the whole truth. Of other effects the "
    "rows are shown, free of all that the rest of the model holds, in groups by what the effect adds to them. Close to "
    "standstill, where an axis sticks and smoothing blurs its speed, curves of friction are rounded."
)


def write_diagnosis(
    directory: Path, document: Document, diagnosis: Diagnosis, source: str, added: Sequence[str]
) -> Path:
    """Write diagnosis.html beside diagnosis.json, whose content `document` is.

    source: the capture. added: lines that the system file gains. Raises InputError where the file cannot be written.
    """
    system = diagnosis.described.system
    heading = escape(system.title or system.name)
    sections = [
        verdict_box(document["judgement"]),
        f"<h1>{heading}</h1><p>Diagnosis of {escape(source)}: {_conditions(diagnosis)}.</p>",
        f'<p class="verdict {document["verdict"]}">{escape(document["summary"])}</p>',
        *(f'<p class="warning">{escape(warning)}</p>' for warning in document["warnings"]),
    ]
    if document["effects"] or document["unexplained"]:
        sections += [
            "<h2>What and where</h2>",
            f'<div class="pair">{_where(document, diagnosis)}{_effects(document)}</div>',
        ]
    laws = law_charts(diagnosis)
    if laws:
        sections += ["<h2>The effect in the data</h2>", f"<p>{HOW_LAWS}</p>", *laws]
    sections += ["<h2>Residual over time</h2>", f"<p>{_how_residuals()}</p>", *residual_charts(diagnosis)]
    sections += ["<h2>Residual before and after</h2>", _residuals(document)]
    sections += ["<h2>Candidates</h2>", _candidates(document)]
    sections += ["<h2>Parameters before and after</h2>", _parameters(document)]
    if added:
        text = escape("\n".join(added))
        sections += ["<h2>Added to the system file</h2>", f"<pre>{text}</pre>"]
    return write_page(directory / NAME, f"{system.name}: diagnosis", "\n".join(sections))


def _conditions(diagnosis: Diagnosis) -> str:
    rows = diagnosis.attempt.rows
    seconds = sum(segment.index.size for segment in rows.segments) / rows.model.system.sample_rate
    held = int(np.count_nonzero(~diagnosis.after.fitted))
    return f"{seconds:.4g} s of samples in {rows.count} windows, {held} of them held out"


def _where(document: Document, diagnosis: Diagnosis) -> str:
    """The arm in the middle of the session, with the effects' numbers at their places."""
    rows = diagnosis.attempt.rows
    # Windows of each filter's width tell another part of the motion.
    first = [motion for motion, _ in rows.weak.motions() if motion.segment == 0]
    order = np.argsort(np.concatenate([motion.samples for motion in first]), kind="stable")
    x = np.concatenate([motion.x for motion in first])[order][:: max(1, order.size // WAY_POINTS)]
    channels = diagnosis.estimator_before.sensing.channels
    marks: dict[str, list[str]] = {}
    for number, effect in enumerate(document["effects"], start=1):
        for place in places_of(effect["where"], channels):
            marks.setdefault(place, []).append(str(number))
    if document["unexplained"] is not None:
        marks.setdefault(document["unexplained"]["row"], []).append("?")
    scene = Scene(rows.model)
    picture = marked_arm(scene, x, len(x) // 2, {place: ", ".join(texts) for place, texts in marks.items()})
    view = "from above" if rows.model.layout.planar else "from one side"
    return f"<figure>{picture}<figcaption>{view}; blue: where the tip has been</figcaption></figure>"


def _effects(document: Document) -> str:
    """Effects with their coefficients, then what cannot be told apart and what would."""
    rows = ["<table>" + _heading(("", "effect", "at", "coefficient"), ("estimate", "± std", "unit"))]
    doubts = []
    for number, effect in enumerate(document["effects"], start=1):
        name, where = escape(effect["name"]), escape(effect["where"])
        start = f'<td>{number}</td><td class="left">{name}</td><td class="left">{where}</td>'
        for coefficient, value in effect["coefficients"].items() or [("", None)]:
            numbers = (
                ["", "", ""]
                if value is None
                else [f"{value['estimate']:.5g}", _number(value["std"], ".2g"), value["unit"]]
            )
            cells = "".join(f"<td>{escape(cell)}</td>" for cell in numbers)
            rows.append(f'<tr>{start}<td class="left">{escape(coefficient)}</td>{cells}</tr>')
            start = "<td></td><td></td><td></td>"
        if effect["ambiguous_with"]:
            others = effect["ambiguous_with"]
            more = f" and {len(others) - LOOK_ALIKES} more" if len(others) > LOOK_ALIKES else ""
            doubts.append(
                f"<p>{number}. This session cannot tell {name} at {where} from "
                f"{escape(', '.join(others[:LOOK_ALIKES]))}{more}. What would: {escape(effect['separated_by'])}.</p>"
            )
    unexplained = document["unexplained"]
    if unexplained is not None:
        variable, speed = escape(unexplained["variable"]), escape(unexplained["speed"])
        share = f"{100.0 * unexplained['share']:.0f} %"
        doubts.append(f"<p>?. A free curve over {variable} in {speed} takes {share} of what is left.</p>")
    table = "\n".join([*rows, "</table>"]) if document["effects"] else ""
    return f"<div>{table}{''.join(doubts)}</div>"


def _how_residuals() -> str:
    return (
        "Of each kind of row the coordinate that was furthest off, each window's residual over the deviation that the "
        f"sensors' noise predicts: {_legend()}. Grey band: ± 2σ of noise alone. Shaded: held out, not fitted to."
    )


def _residuals(document: Document) -> str:
    """By row type, fitted and held out, and what noise alone would leave."""
    rows = [
        '<table><tr><th></th><th colspan="5" class="over">over the predicted deviation, 1 is noise</th>'
        '<th colspan="4" class="over">share of the measured torque or force</th></tr><tr><th>rows</th>'
        "<th>fitted: before</th><th>after</th><th>held out: before</th><th>after</th><th>limit of noise</th>"
        "<th>fitted: before</th><th>after</th><th>held out: before</th><th>after</th></tr>"
    ]
    before, after = document["before"], document["after"]
    for row in before["fit"]:
        parts = [part[row] for half in ("fit", "holdout") for part in (before[half], after[half])]
        limit = after["limit"][row]
        whitened = [_graded(part["whitened"], limit) for part in parts]
        relative = [f"<td>{_number(part['relative'], '.3g')}</td>" for part in parts]
        cells = [*whitened, f"<td>{limit:.3g}</td>", *relative]
        rows.append(f"<tr><td>{escape(row)}</td>{''.join(cells)}</tr>")
    return "\n".join([*rows, "</table>"])


def _graded(value: float, limit: float) -> str:
    kind = ' class="beyond"' if value > limit else ""
    return f"<td{kind}>{value:.3g}</td>"


def _candidates(document: Document) -> str:
    """The best by what each alone takes away, effects found and their look-alikes coloured."""
    numbers = {(e["name"], e["where"]): n for n, e in enumerate(document["effects"], start=1)}
    like: dict[str, list[str]] = {}
    for number, effect in enumerate(document["effects"], start=1):
        for key in effect["ambiguous_with"]:
            like.setdefault(key, []).append(str(number))
    rows = ["<table>" + _heading(("", "effect", "at", "share taken alone"), ("%", ""))]
    for rank, candidate in enumerate(document["candidates"], start=1):
        name, where, share = candidate["name"], candidate["where"], candidate["share"]
        found, likes = numbers.get((name, where)), like.get(f"{name}@{where}")
        if rank > LISTED and found is None:
            continue
        color = FOUND if found else LIKE if likes else OTHER
        remark = f"found: {found}" if found else f"cannot be told from {', '.join(likes)}" if likes else ""
        bar = f'<rect x="0" y="2" width="{SHARE_WIDTH * share:.1f}" height="{SHARE_HEIGHT - 4}" fill="{color}"/>'
        rows.append(
            f'<tr><td>{rank}</td><td class="left">{escape(name)}</td><td class="left">{escape(where)}</td>'
            f'<td class="left">{svg(SHARE_WIDTH, SHARE_HEIGHT, bar)}</td><td>{100.0 * share:.3g}</td>'
            f'<td class="left">{remark}</td></tr>'
        )
    table = "\n".join([*rows, "</table>"])
    why = (
        "What each of them alone would take of the residual beyond noise, against the model as described; shares "
        f"overlap, and what one found leaves goes to the next. {len(document['candidates'])} were tried."
    )
    return f"<p>{why}</p>{table}"


def _parameters(document: Document) -> str:
    """Estimates of both models; bars about the true value where it is known, else about the estimate after."""
    before = {p["name"]: p for p in document["before"]["parameters"]}
    after = document["after"]["parameters"]
    changed = bool(document["effects"])
    is_true = any(p["true"] is not None for p in after)
    deviations = np.full((len(after), 2, 2), np.nan)  # before and after; estimate from reference, 2σ, %
    for k, p in enumerate(after):
        reference = p["true"] if is_true else p["estimate"] if p["identifiable"] else None
        for j, each in enumerate((before.get(p["name"]), p)):
            if each is not None and each["identifiable"] and reference:
                size = abs(reference) / 100.0
                deviations[k, j] = (each["estimate"] - reference) / size, BOUNDS * each["std"] / size
    limit = half_range(np.abs(deviations).sum(axis=2).ravel())
    columns = ["before", *(["after"] if changed else [])]
    headings = [f"{column} ± std" for column in columns]
    if is_true:
        headings += ["true", *(f"% off {column}" for column in columns)]
    elif changed:
        headings.append("% off before")
    headings.append(f"± 2σ, axis ± {limit:g} %")
    cells = "".join(f"<th>{heading}</th>" for heading in headings)
    rows = [f'<table class="dense"><tr><th>parameter</th><th class="left">unit</th>{cells}</tr>']
    for p, own in zip(after, deviations, strict=True):
        shown = [before.get(p["name"]), *([p] if changed else [])]
        numbers = [_estimate(each) for each in shown]
        if is_true:
            numbers.append("" if p["true"] is None else f"{p['true']:.6g}")
        off = own[: len(columns), 0] if is_true else own[: len(columns) - 1, 0]
        numbers += ["" if np.isnan(each) else f"{each:+.2g}" for each in off]
        bars = [
            Bar(float(deviation), float(bound), color)
            for (deviation, bound), color in zip(own[: len(columns)], (BEFORE, AFTER), strict=False)
        ]
        numbers.append(error_bars(bars, limit))
        kind = "" if p["identifiable"] else ' class="unknown"'
        start = f'<td>{escape(p["name"])}</td><td class="left">{escape(p["unit"])}</td>'
        rows.append(f"<tr{kind}>{start}{''.join(f'<td>{number}</td>' for number in numbers)}</tr>")
    about = "the true value" if is_true else "the value after"
    legend = f"<p>Bars stand about {about}: {_legend()}.</p>" if changed else ""
    return "\n".join([legend, *rows, "</table>"])


def _legend() -> str:
    return f'<b style="color: {BEFORE}">before</b>, <b style="color: {AFTER}">after</b>'


def _estimate(p: Document | None) -> str:
    if p is None or not p["identifiable"]:
        return "" if p is None else NOT_DETERMINED
    return f"{formatter(p['estimate'], p['std'])(p['estimate'])} ± {p['std']:.2g}"


def _heading(left: Sequence[str], right: Sequence[str]) -> str:
    cells = [*(f'<th class="left">{text}</th>' for text in left), *(f"<th>{text}</th>" for text in right)]
    return f"<tr>{''.join(cells)}</tr>"


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)
