"""check: what is the matter with a capture, and what its motion determines, before it is estimated from."""

from __future__ import annotations

import argparse

from rich.text import Text

from sms_adapters.data_check import check, joined
from sms_online.recorded import Recorded
from sms_tools.exit_codes import NOT_FIT, OK
from sms_tools.report import say, table
from sms_tools.results_file import results_directory, write_document
from sms_tools.session import described_system
from sms_tools.waiting import watched

NAME = "check.json"


def run(args: argparse.Namespace) -> int:
    """Print the page; 0, 1 where estimates from the capture will suffer."""
    system, folder = described_system(args)
    directory = None if args.out is None else results_directory(args.out)
    with watched(args.capture, system, folder) as reading:
        found = check(system, Recorded(reading, str(args.capture)))
    lines = [Text(line, "bold red" if grave else "yellow") for grave, line in joined(found.remarks)]
    motion = [f"  {line}" for line in found.motion()]
    motion = ["the motion and its sensors determine", *motion] if motion else []
    verdict = Text("fit to be estimated from", "bold green") if found.passed else Text("not as described", "bold red")
    written = [] if directory is None else [f"check: {write_document(directory / NAME, found.to_json())}"]
    shown = table(*found.rows(), left=("channel", "unit"))
    say(args, shown, "", *lines, "", *motion, "", verdict, *written, document=found.to_json())
    return OK if found.passed else NOT_FIT
