"""show: a described arm with its frames, joints, markers and channels, before there are any data."""

from __future__ import annotations

import argparse

from sms_online.tables import json_text
from sms_tools.exit_codes import OK
from sms_tools.report import report_console
from sms_tools.report import show as print_to
from sms_tools.results_file import RUNS, results_directory
from sms_tools.session import described_system
from sms_tools.view.described import channel_table, show


def run(args: argparse.Namespace) -> int:
    """Say which channels there are, and open the view."""
    system, _ = described_system(args)
    table = channel_table(system)
    print_to(report_console(args.json), *(f"{row.place}: {', '.join(row.channels)}" for row in table))
    directory = args.out or RUNS / "show"
    if args.rerun == "save":
        results_directory(directory)
    place = show(system, rerun=args.rerun, directory=directory, exaggeration=args.exaggerate)
    if args.json:
        places = [{"place": row.place, "channels": row.channels} for row in table]
        print(json_text({"schema": "sms-online/show/1", "view": place, "places": places}))
    return OK
