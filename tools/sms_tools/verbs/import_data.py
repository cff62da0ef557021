"""import: a published measurement as a capture."""

from __future__ import annotations

import argparse

from sms_adapters.importers import import_emps, import_quanser
from sms_adapters.truth import truth_path
from sms_online.result import json_text
from sms_tools.exit_codes import OK
from sms_tools.report import report_console, show

IMPORTERS = {"emps": import_emps, "quanser": import_quanser}


def run(args: argparse.Namespace) -> int:
    """Write the capture and say how long it is."""
    samples = IMPORTERS[args.kind](args.source, args.capture)
    # What a simulation of the same name left would pass for the truth of a measurement.
    truth_path(args.capture).unlink(missing_ok=True)
    show(report_console(args.json), f"capture: {args.capture}, {samples} samples")
    if args.json:
        print(json_text({"schema": "sms-online/import/1", "capture": str(args.capture), "samples": samples}))
    return OK
