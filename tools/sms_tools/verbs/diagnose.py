"""diagnose: what a capture holds that its system file does not describe."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path

from rich.table import Table
from rich.text import Text

from sms_adapters.sources import open_source
from sms_adapters.truth import read_truth
from sms_online.description.schema import System
from sms_online.diagnosis.attempt import PriorOf
from sms_online.diagnosis.diagnose import Diagnosis, diagnose
from sms_online.diagnosis.document import diagnosis_document, judgement
from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Block
from sms_online.trackers.interface import Prior
from sms_tools.adopted_system import added_lines, adopted_text, cells_of, remarks, write_adopted
from sms_tools.exit_codes import NOTHING_DETERMINED, OK
from sms_tools.interruption import Interruption
from sms_tools.priors import base_prior
from sms_tools.report import Document, parameter_table, report_console, show, verdict_text
from sms_tools.results_file import results_directory, to_json, write_document
from sms_tools.session import check_part, described_system, stream
from sms_tools.true_values import true_values
from sms_tools.view.frames import Diagnosed
from sms_tools.view.parameter_groups import MOST_LINES
from sms_tools.view.session import View, open_view

NAME = "diagnosis.json"
# Ambiguous candidates that people are shown.
SHOWN = 8


def run(args: argparse.Namespace) -> int:
    """Diagnose a capture; 0, or 3 where nothing is determined."""
    check_part(args)
    system, folder = described_system(args)
    directory = results_directory(args.out)
    console = report_console(args.json)
    blocks, warnings = _samples(args.capture, system, args.start, args.stop, folder)
    holdout: list[Block] = []
    if args.holdout is not None:
        start = None
        if args.holdout == args.capture:
            if args.stop is None:
                expected = "-to SECONDS beside it: what comes after is held out then"
                raise InputError("--holdout", "", "the capture itself", expected)
            start = args.stop
        holdout, more = _samples(args.holdout, system, start, None, folder)
        warnings += more
        if holdout[0].channels != blocks[0].channels:
            raise InputError(str(args.holdout), "header", ", ".join(holdout[0].channels), ", ".join(blocks[0].channels))
    truth = read_truth(args.capture)

    def prior(estimator: Estimator) -> Prior | None:
        return base_prior(system, estimator.base, args.prior) if args.prior or system.priors else None

    def progress(message: str) -> None:
        console.print(f"{message} …", markup=False, style="dim")

    diagnosis = diagnose(system, blocks, str(args.capture), prior, holdout, progress)
    true = None if truth is None else true_values(truth, system, diagnosis.after.system)
    document = diagnosis_document(diagnosis, warnings, true)
    view = None if args.rerun == "off" else _watched(args, diagnosis, document, blocks, directory, prior, true)
    document["warnings"] += [] if view is None else view.warnings
    lines: list[Table | str | Text] = ["", document["summary"], ""]
    if document["effects"]:
        lines += [_effects(document), ""]
    # See `diagnosis_document`.
    origin = "by a replay with it" if diagnosis.attempt.prior is None else "from the rows of the diagnosis"
    title = f"parameters with what was found, {origin}"
    lines += [_residuals(document), "", parameter_table(document["after"], console.width, title=title), ""]
    lines += [f"warning: {warning}" for warning in document["warnings"]]
    path = write_document(directory / NAME, document)
    added: list[str] = []
    if diagnosis.after.system != system:
        text = adopted_text(args.system, system, diagnosis.after.system, remarks(document["effects"]))
        added = added_lines(args.system, text)
        lines.append(f"system file with what was found: {write_adopted(directory, text)}")
    # Matplotlib takes a second to be imported, which nobody should wait for before the diagnosis.
    from sms_tools.html_report.diagnosis_page import write_diagnosis

    page = write_diagnosis(directory, document, diagnosis, args.capture.name, added)
    show(console, *lines, f"diagnosis: {path}", f"page: {page}", "", verdict_text(document["judgement"]))
    if args.json:
        print(to_json(document))
    if view is not None:
        with Interruption() as interruption:
            view.linger(interruption)
    return OK if any(p["identifiable"] for p in document["after"]["parameters"]) else NOTHING_DETERMINED


def _watched(
    args: argparse.Namespace,
    diagnosis: Diagnosis,
    document: Document,
    blocks: list[Block],
    directory: Path,
    prior: PriorOf,
    true: Mapping[str, float] | None,
) -> View:
    """The session once more in view, with what was found; with it the first candidates' evidence, and the verdict."""
    channels = blocks[0].channels
    estimator = Estimator(diagnosis.after.system, channels, str(args.capture))
    known = prior(estimator)
    told: dict[str, tuple[float, float]] = {}
    if known is not None:
        estimator.set_prior(known)
        # These come from the diagnosis's rows, not from a session; see `diagnosis_document`.
        after = document["after"]["parameters"]
        told = {p["name"]: (p["estimate"], math.inf if p["std"] is None else p["std"]) for p in after}
    with (
        Interruption() as interruption,
        open_view(
            args.rerun,
            estimator,
            channels,
            directory,
            true,
            patient=True,
            exaggeration=args.exaggerate,
            diagnosed=Diagnosed(told, judgement(diagnosis)),
        ) as view,
    ):
        stream(estimator, view.watch(blocks), interruption)
        scores = _evidence(document)
        # Judged by all of the capture, so it holds from beginning to end.
        begin, end = float(blocks[0].t[0]), float(blocks[-1].t[-1])
        for t in (begin, end):
            view.evidence(t, scores)
        view.event(end, document["summary"])
        told_of = remarks(document["effects"])
        for effect in document["effects"]:
            key = f"{effect['name']}@{effect['where']}"
            view.event(end, ", ".join(filter(None, (key, told_of[key]))))
    return view


def _evidence(document: Document) -> dict[str, float]:
    """log10 of the gain, before anything was taken up, of what was named and of the best others, MOST_LINES in all.

    What was found by comparing whole descriptions has the gain of that comparison, for as a candidate it gains nothing.
    """
    named = {f"{effect['name']}@{effect['where']}": effect["evidence"]["gain"] for effect in document["effects"]}
    ranked = {f"{candidate['name']}@{candidate['where']}": candidate["gain"] for candidate in document["candidates"]}
    late = {name: gain for name, gain in named.items() if ranked.get(name, 0.0) < 1.0}
    # A union keeps the order of what was named, and takes the later numbers.
    gains = list((named | ranked | late).items())[: max(MOST_LINES, len(named))]
    return {name: math.log10(max(1.0, gain)) for name, gain in gains}


def _samples(
    capture: Path, system: System, start: float | None, stop: float | None, folder: Path | None
) -> tuple[list[Block], list[str]]:
    source = open_source(capture, system, start, stop, None, folder)
    blocks = list(source)
    if not blocks:
        raise InputError(str(capture), "", "no samples", "a capture with samples in the time asked for")
    return blocks, list(source.warnings)


def _effects(document: Document) -> Table:
    table = Table(
        title="effects, from the rows of the diagnosis",
        title_justify="left",
        box=None,
        header_style="bold",
        pad_edge=False,
    )
    for heading in ("effect", "coefficient", "estimate", "± std", "unit", "cannot be told from"):
        table.add_column(heading, justify="right" if heading in ("estimate", "± std") else "left", overflow="fold")
    for effect in document["effects"]:
        others = ", ".join(effect["ambiguous_with"][:SHOWN])
        first = True
        for name, value in effect["coefficients"].items() or [("", None)]:
            cells = ["", "", ""] if value is None else cells_of(value)
            table.add_row(f"{effect['name']}@{effect['where']}" if first else "", name, *cells, others if first else "")
            first = False
    return table


def _residuals(document: Document) -> Table:
    title = "residual on data not fitted"
    table = Table(title=title, title_justify="left", box=None, header_style="bold", pad_edge=False)
    for heading in ("rows", "× noise before", "after", "share of torque before", "after"):
        table.add_column(heading, justify="left" if heading == "rows" else "right")
    parts = [document[state]["holdout"] for state in ("before", "after")]
    for row in parts[0]:
        whitened, relative = ([part[row][measure] for part in parts] for measure in ("whitened", "relative"))
        table.add_row(row, *(f"{w:.3g}" for w in whitened), *("" if r is None else f"{r:.3g}" for r in relative))
    return table
