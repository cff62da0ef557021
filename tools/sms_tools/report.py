"""results.json as a person reads it: a table of the parameters, then how far to trust it."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Collection, Iterable, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from sms_online.calibration.found import Calibration
from sms_online.tables import formatter, json_text

# Width of a table that goes to a file or a pipe, where there is no terminal to ask.
FILE_WIDTH = 140
# A terminal narrower than this has no room for what intervals and errors say already: ± std, the true values.
WIDTH_WITH_ALL = 112
NOT_DETERMINED = "not determined"
# Of a verdict, by its level; what is grave is red.
LEVEL_STYLES = {"trust": "bold green", "doubt": "bold yellow", "not yet": "bold bright_black"}
GRAVE_STYLE = "bold red"
METHODS = {
    "energy": "energy balance",
    "momentum": "momentum balance",
    "smoother": "smoother that knows the dynamics",
}

Document = dict[str, Any]


def report_console(json: bool) -> Console:
    """Where people read: stdout, or stderr where stdout belongs to a JSON document."""
    stream = sys.stderr if json else sys.stdout
    return plain_console(file=stream, width=None if stream.isatty() else FILE_WIDTH)


def plain_console(**settings: Any) -> Console:
    """A console that shows paths and messages as they are: `[x]` is no style in them, `:abc:` no picture."""
    return Console(highlight=False, markup=False, emoji=False, **settings)


def show(console: Console, *parts: Table | str | Text) -> None:
    """Print; raises BrokenPipeError, which rich itself would turn into an exit code of its own."""
    with console.capture() as capture:
        for part in parts:
            console.print(part, soft_wrap=not isinstance(part, Table))
    console.file.write(capture.get())


def say(args: argparse.Namespace, *parts: Table | str | Text, document: str | dict[str, Any]) -> None:
    """Print for people, and with --json the document, as its text or as numbers and names, for programs."""
    show(report_console(args.json), *parts)
    if args.json:
        print(document if isinstance(document, str) else json_text(document))


def table(
    headings: Sequence[str],
    rows: Iterable[Sequence[str]] = (),
    left: Collection[str] = (),
    title: str | Text | None = None,
) -> Table:
    """Cells below their headings, those below `left` aligned to the left."""
    out = Table(title=title, title_justify="left", box=None, header_style="bold", pad_edge=False)
    for heading in headings:
        out.add_column(heading, justify="left" if heading in left else "right", overflow="fold")
    for cells in rows:
        out.add_row(*cells)
    return out


def verdict_text(verdict: Document) -> Text:
    """Whether to trust the numbers, in its colour, and the other reasons below."""
    style = GRAVE_STYLE if verdict["grave"] else LEVEL_STYLES[verdict["level"]]
    lines = [Text(verdict["sentence"], style), *(Text(f"  {each}") for each in verdict["reasons"][1:])]
    return Text("\n").join([*lines, *([Text(f"  next: {verdict['next_step']}")] if verdict["next_step"] else [])])


def parameter_table(document: Document, width: int, title: str | Text | None = None) -> Table:
    """Parameters with their estimates and intervals, and their errors where the truth is known.

    Where `width` allows it also ± std and the truth.
    """
    parameters = document["parameters"]
    simulated = any(p["true"] is not None for p in parameters)
    out = table(("parameter", "unit"), left=("parameter", "unit"), title=title)
    wide = width >= WIDTH_WITH_ALL
    headings = ["estimate"] + ["± std"] * wide + ["95 % interval"] + ["true"] * (simulated and wide)
    headings += ["error %"] * simulated
    for heading in headings:
        out.add_column(heading, justify="right", no_wrap=True)
    for p in parameters:
        cells = [p["name"], p["unit"]]
        estimate, std, interval = estimate_cells(p)
        cells += [estimate, *[std] * wide, interval] if std else [estimate, _in_doubt(p), *[""] * wide]
        if simulated:
            cells += ["" if p["true"] is None else f"{p['true']:.6g}"] * wide
            cells.append(_error(p))
        out.add_row(*cells, style=None if p["identifiable"] else "dim")
    return out


def tracker_table(document: Document) -> Table | None:
    """Each tracker's estimate of each parameter, where there are several; None where there is one."""
    trackers = document.get("trackers", [])
    if len(trackers) < 2:
        return None
    out = table(("parameter", "unit"), left=("parameter", "unit"), title="trackers on the same rows")
    for tracker in trackers:
        out.add_column(tracker["name"] + (", judged" if tracker["judged"] else ""), justify="right", no_wrap=True)
    for p, *row in zip(document["parameters"], *(tracker["parameters"] for tracker in trackers), strict=True):
        out.add_row(p["name"], p["unit"], *map(value_cell, row))
    for heading, cells in tracker_facts(trackers).items():
        out.add_row(heading, "", *cells, style="dim")
    return out


def estimate_cells(p: Document) -> tuple[str, str, str]:
    """Estimate, standard deviation and 95 % interval; the first alone where it is not determined."""
    if not p["identifiable"]:
        return NOT_DETERMINED, "", ""
    shown = formatter(p["estimate"], p["std"])
    return shown(p["estimate"]), f"{p['std']:.2g}", f"{shown(p['lower95'])} … {shown(p['upper95'])}"


def value_cell(parameter: Document) -> str:
    """A tracker's value ± std of a parameter."""
    if not parameter["identifiable"]:
        return NOT_DETERMINED
    return f"{formatter(parameter['estimate'], parameter['std'])(parameter['estimate'])} ± {parameter['std']:.2g}"


def tracker_facts(trackers: list[Document]) -> dict[str, list[str]]:
    """Normalised innovations squared with their band, and the memory in effect, of each tracker."""
    nis = [
        "–"
        if t["nis"] is None
        else f"{t['nis']:.4g} ({t['nis_lower']:.3g} … {t['nis_upper']:.3g}{'' if t['consistent'] else ', outside'})"
        for t in trackers
    ]
    return {"innovations squared": nis, "memory": [f"{t['memory_s']:.3g} s" for t in trackers]}


def _in_doubt(p: Document) -> str:
    """An undetermined parameter in words: enough to see why it is so, too little to copy down."""
    return "" if p["std"] is None else f"({p['estimate']:.2g} ± {p['std']:.1g})"


def _error(p: Document) -> str:
    if not p["identifiable"] or not p["true"]:
        return ""
    return f"{100.0 * (p['estimate'] / p['true'] - 1.0):+.2g}"


def event_line(event: Document) -> str:
    """What changed and when; parameters and residuals hold since the last such line."""
    jumps = [f"{p['name']} {p['size']:+.4g} ± {p['std']:.2g} {p['unit']}" for p in event["parameters"]]
    return f"event at {event['time']:.3f} s: {event['kind']} {', '.join(jumps)}".rstrip()


def drift_lines(document: Document) -> list[str]:
    """Parameters that the judged tracker has found to drift, a line each."""
    drifts = [drift for tracker in document.get("trackers", []) if tracker["judged"] for drift in tracker["drifts"]]
    return [_drift_line(d) for d in drifts]


def _drift_line(d: Document) -> str:
    changed = "" if d.get("changed") is None else f", at this rate since {d['changed']:.1f} s"
    rate = f"{d['rate']:+.4g} ± {d['rate_std']:.2g} {d['unit']} per s"
    line = f"drift since {d['since']:.1f} s{changed}: {d['parameter']} {rate}"
    if d["value_std"] is None:
        return line
    value = formatter(d["value"], d["value_std"])(d["value"])
    return f"{line}, {value} ± {d['value_std']:.2g} {d['unit']} now"


def trust_lines(document: Document) -> list[str]:
    """Events, calibration, residual, condition number, amount of data, throughput and warnings, a line each."""
    lines = [event_line(event) for event in document["events"]] + drift_lines(document)
    lines += [f"diagnosis: {episode['summary']}" for episode in document.get("diagnosis", [])]
    calibration = [Calibration(**entry) for entry in document.get("calibration", [])]
    lines += [f"calibration: {each}" for each in calibration if each.certain]
    for rows, residual in document["residual"].items():
        if residual["relative"] is not None:
            lines.append(f"residual {rows}: {residual['relative']:.3g} of the measured torque or force")
        if residual["whitened"] is not None:
            lines.append(f"residual {rows}: {residual['whitened']:.3g} of its predicted deviation")
    lines.append(f"method: {METHODS[document['method']]}")
    condition = document["condition_number"]
    full_rank = condition is not None and math.isfinite(condition)
    lines.append(f"condition number: {condition:.3g}" if full_rank else "condition number: infinite")
    lost = document["lost_samples"]
    lines.append(f"samples: {document['samples']} in {document['duration_s']:.6g} s, {lost} lost")
    lines.append(f"throughput: {document['throughput_samples_per_s']:,.0f} samples/s")
    return lines + [f"warning: {warning}" for warning in document["warnings"]]
