"""diagnose: what a capture holds that its system file does not describe."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from rich.table import Table
from rich.text import Text

from sms_adapters.files import write_text
from sms_adapters.recorded import captured, recorded_at
from sms_adapters.session_log import SYSTEM
from sms_online.capture import Capture
from sms_online.description.schema import System
from sms_online.diagnosed import Diagnosis, diagnose
from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator
from sms_online.tables import json_text
from sms_online.truth import true_values
from sms_tools.adopted_system import added_lines, adopted_text, remarks
from sms_tools.exit_codes import INTERRUPTED, NOTHING_DETERMINED, OK
from sms_tools.found_effects import cells_of, look_alikes, why
from sms_tools.interruption import Interruption
from sms_tools.report import Document, parameter_table, report_console, show, table, verdict_text
from sms_tools.results_file import results_directory, write_document
from sms_tools.session import check_part, described_system
from sms_tools.view.frames import Diagnosed
from sms_tools.view.parameter_groups import MOST_LINES
from sms_tools.view.session import View, open_view
from sms_tools.waiting import waiting, watched

NAME = "diagnosis.json"


def run(args: argparse.Namespace) -> int:
    """Diagnose captures; 0, or 3 where nothing is determined."""
    check_part(args)
    system, folder = described_system(args)
    directory = results_directory(args.out)
    console = report_console(args.json)
    captures = [_samples(path, system, args.start, args.stop, folder) for path in args.captures]
    holdout: Capture | None = None
    if args.holdout is not None:
        start = None
        if args.holdout in args.captures:
            if args.stop is None:
                expected = "-to SECONDS beside it: what comes after is held out then"
                raise InputError("--holdout", "", "the capture itself", expected)
            start = args.stop
        holdout = _samples(args.holdout, system, start, None, folder)

    with waiting() as progress, Interruption() as interruption:
        found = diagnose(
            system,
            captures,
            holdout=holdout,
            prior=args.prior,
            progress=progress,
            stop=lambda: interruption.requested,
            learned=args.learn,
        )
    document = found.document()
    # Shown is the first: what was found is the same in all.
    view = None if args.rerun == "off" else _watched(args, system, found, captures[0], directory)
    if view is not None:
        document["warnings"] = [*document["warnings"], *view.warnings]
    lines: list[Table | str | Text] = ["", found.summary, ""]
    lines += [f"next: {each['next_step']}" for each in (*document["mistakes"], *document["calibration"])]
    if document["effects"]:
        lines += [_effects(document), "", *filter(None, map(why, document["effects"])), ""]
    # See `diagnosis_document`.
    origin = "from the rows of the diagnosis" if found.search.by_rows else "by a replay with it"
    title = f"parameters with what was found, {origin}"
    lines += [_residuals(document), "", parameter_table(document["after"], console.width, title=title), ""]
    lines += [f"warning: {warning}" for warning in document["warnings"]]
    text = json_text(document)
    path = write_document(directory / NAME, text)
    added: list[str] = []
    if found.system != system:
        adopted = adopted_text(args.system, system, found.system, remarks(document["effects"]))
        added = added_lines(args.system, adopted)
        lines.append(f"system file with what was found: {write_text(directory / SYSTEM, adopted)}")
    # Matplotlib takes a second to be imported, which nobody should wait for before the diagnosis.
    from sms_tools.html_report.diagnosis_page import write_diagnosis

    page = write_diagnosis(directory, document, found.search, ", ".join(p.name for p in args.captures), added)
    show(console, *lines, f"diagnosis: {path}", f"page: {page}", "", verdict_text(document["judgement"]))
    if args.json:
        print(text)
    if view is not None:
        with Interruption() as interruption:
            view.linger(interruption)
    if found.search.partial:
        return INTERRUPTED
    return OK if any(p.determined for p in found.after.parameters.values()) else NOTHING_DETERMINED


def _watched(args: argparse.Namespace, system: System, found: Diagnosis, capture: Capture, directory: Path) -> View:
    """The session once more in view, with what was found; with it the first candidates' evidence, and the verdict."""
    document = found.document()
    # What is to be seen has been found already: no diagnosis runs beside it.
    # Estimated anew: what was fitted to these samples is nothing known of them beforehand.
    after = found.search.adopted
    estimator = Estimator(after, capture.channels, str(args.captures[0]), whole=True)
    estimates: dict[str, tuple[float, float]] = {}
    if (known := found.search.attempt.case.prior(estimator)) is not None:
        estimator.set_prior(known)
    if found.search.by_rows:
        # These come from the diagnosis's rows, not from a session; see `diagnosis_document`.
        estimates = {p.name: (p.value, p.std) for p in found.after.parameters.values()}
    with (
        Interruption() as interruption,
        open_view(
            args.rerun,
            estimator,
            capture.channels,
            directory,
            None if capture.truth is None else true_values(capture.truth, system, after),
            patient=True,
            exaggeration=args.exaggerate,
            diagnosed=Diagnosed(estimates, found.trust),
        ) as view,
    ):
        for block in view.watch(capture):
            estimator.push(block)
            if interruption.requested:
                break
        estimator.finish()
        scores = _evidence(document)
        # Judged by all of the capture, so it holds from beginning to end.
        begin, end = float(capture.t[0]), float(capture.t[-1])
        for t in (begin, end):
            view.evidence(t, scores)
        view.event(end, found.summary)
        said = remarks(document["effects"])
        for finding in found.effects:
            view.event(end, ", ".join(filter(None, (finding.effect, said[finding.effect]))))
    return view


def _evidence(document: Document) -> dict[str, float]:
    """log10 of the gain, before anything was selected, of what was named and of the best others, MOST_LINES in all.

    What was found by comparing whole descriptions has the gain of that comparison, for as a candidate it gains nothing.
    """
    named = {f"{effect['name']}@{effect['where']}": effect["evidence"]["gain"] for effect in document["effects"]}
    ranked = {f"{candidate['name']}@{candidate['where']}": candidate["gain"] for candidate in document["candidates"]}
    late = {name: gain for name, gain in named.items() if ranked.get(name, 0.0) < 1.0}
    # A union keeps the order of what was named, and takes the later numbers.
    gains = list((named | ranked | late).items())[: max(MOST_LINES, len(named))]
    return {name: math.log10(max(1.0, gain)) for name, gain in gains}


def _samples(capture: Path, system: System, start: float | None, stop: float | None, folder: Path | None) -> Capture:
    with watched(capture, system, folder, start, stop) as reading:
        return captured(recorded_at(capture, reading))


def _effects(document: Document) -> Table:
    rows = []
    for effect in document["effects"]:
        first, others = f"{effect['name']}@{effect['where']}", look_alikes(effect)
        for name, value in effect["coefficients"].items() or [("", None)]:
            rows.append([first, name, *(["", "", ""] if value is None else cells_of(value)), others])
            first = others = ""
    headings = ("effect", "coefficient", "estimate", "± std", "unit", "indistinguishable from")
    left = [heading for heading in headings if heading not in ("estimate", "± std")]
    return table(headings, rows, left, title="effects, from the rows of the diagnosis")


def _residuals(document: Document) -> Table:
    parts = [document[state]["holdout"] for state in ("before", "after")]
    rows = []
    for row in parts[0]:
        whitened, relative = ([part[row][measure] for part in parts] for measure in ("whitened", "relative"))
        rows.append([row, *(f"{w:.3g}" for w in whitened), *("" if r is None else f"{r:.3g}" for r in relative)])
    headings = ("rows", "× noise before", "after", "share of torque before", "after")
    return table(headings, rows, left=("rows",), title="residual on held-out data")
