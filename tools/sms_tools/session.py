"""What the verbs share: the system asked for, samples fed to a session, and what is made of its end."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from rich.table import Table

from sms_adapters.files import write_text
from sms_adapters.history_file import NAME as HISTORY
from sms_adapters.history_file import write_history
from sms_adapters.runs import NAME as RESULTS
from sms_adapters.system_file import load_system
from sms_online.description.given import given_system
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.result import Result
from sms_online.session import Session, with_trackers
from sms_online.stream import Block
from sms_tools.adopted_system import ONLINE_NAME, adopted_text, remarks
from sms_tools.exit_codes import INTERRUPTED, NOTHING_DETERMINED, OK
from sms_tools.interruption import Interruption
from sms_tools.report import parameter_table, report_console, show, tracker_table, trust_lines
from sms_tools.results_file import write_document


def described_system(args: argparse.Namespace) -> tuple[System, Path | None]:
    """The system asked for, and the directory of its file, where its DBC lies too; None for a shipped one."""
    system, folder = given_system(args.system)
    return with_trackers(system, getattr(args, "tracker", None)), folder


def check_part(args: argparse.Namespace) -> None:
    """InputError where -to is not after -ss."""
    if args.stop is not None and args.start is not None and args.stop <= args.start:
        raise InputError("-to", "", f"{args.stop:g} s", f"a time after -ss {args.start:g} s")


def feed(session: Session, blocks: Iterable[Block], interruption: Interruption) -> None:
    """Update a session until its blocks or the person's patience end, then finish it."""
    for block in blocks:
        session.update(block)
        if interruption.requested:
            break
    session.finish()


def conclude(args: argparse.Namespace, result: Result, directory: Path, interrupted: bool) -> int:
    """Write results.json and the history, print it for people or programs, and say how the session ended."""
    if interrupted:
        result = replace(result, warnings=(*result.warnings, "interrupted: the results use the samples until then"))
    document = result.document()
    console = report_console(args.json)
    parts: list[Table | str] = [parameter_table(document, console.width), "", *trust_lines(document)]
    trackers = tracker_table(document)
    if trackers is not None:
        parts[1:1] = ["", trackers]
    try:
        path = write_document(directory / RESULTS, result.to_json())
    except InputError:
        # A disk that refuses the file must not take the numbers with it.
        show(console, *parts)
        raise
    show(console, *parts, f"results: {path}")
    if result.history:
        show(console, f"history: {write_history(directory / HISTORY, result.history)}")
    if args.json:
        print(result.to_json())
    if interrupted:
        return INTERRUPTED
    return OK if any(p.determined for p in result.parameters.values()) else NOTHING_DETERMINED


def write_named(args: argparse.Namespace, session: Session, directory: Path) -> None:
    """With --adopt, the system file with what was named, if anything was."""
    system = session.diagnosis.system
    described = with_trackers(load_system(args.system), session.system.trackers)
    if args.adopt and system != described:
        found = [effect for episode in session.diagnosis.document() for effect in episode["effects"]]
        path = write_text(directory / ONLINE_NAME, adopted_text(args.system, described, system, remarks(found)))
        show(report_console(args.json), f"system file with what was found: {path}")
