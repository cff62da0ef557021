"""check: what is the matter with a capture, and what its motion determines, before it is estimated from."""

from __future__ import annotations

import argparse

from rich.table import Table
from rich.text import Text

from sms_adapters.data_check import Check, check, joined
from sms_adapters.sources import open_source
from sms_online.session import Recorded
from sms_tools.exit_codes import NOT_FIT, OK
from sms_tools.report import report_console, show
from sms_tools.results_file import write_document
from sms_tools.session import described_system
from sms_tools.waiting import watched

NAME = "check.json"


def run(args: argparse.Namespace) -> int:
    """Print the page; 0, 1 where estimates from the capture will suffer."""
    system, folder = described_system(args)
    console = report_console(args.json)
    with watched(args.capture, lambda moved: open_source(args.capture, system, None, None, moved, folder)) as reading:
        found = check(system, Recorded(reading, str(args.capture)))
    lines = [Text(line, "bold red" if grave else "yellow") for grave, line in joined(found.remarks)]
    motion = [f"  {line}" for line in found.motion()]
    motion = ["the motion and its sensors determine", *motion] if motion else []
    verdict = Text("fit to be estimated from", "bold green") if found.passed else Text("not as described", "bold red")
    show(console, _table(found), "", *lines, "", *motion, "", verdict)
    if args.out is not None:
        show(console, f"check: {write_document(args.out / NAME, found.to_json())}")
    if args.json:
        print(found.to_json())
    return OK if found.passed else NOT_FIT


def _table(found: Check) -> Table:
    headings, rows = found.rows()
    table = Table(box=None, header_style="bold", pad_edge=False)
    for heading in headings:
        table.add_column(heading, justify="left" if heading in ("channel", "unit") else "right")
    for cells in rows:
        table.add_row(*cells)
    return table
