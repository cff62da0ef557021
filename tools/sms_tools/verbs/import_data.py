"""import: a published measurement as a capture."""

from __future__ import annotations

import argparse

from sms_adapters.importers import import_emps, import_quanser
from sms_adapters.truth import truth_path
from sms_online.errors import InputError
from sms_online.result import json_text
from sms_tools.exit_codes import OK
from sms_tools.report import report_console, show
from sms_tools.verbs import import_urdf

IMPORTERS = {"emps": import_emps, "quanser": import_quanser}


def run(args: argparse.Namespace) -> int:
    """Write the capture and say how long it is, or the system file of a URDF."""
    if args.kind == "urdf":
        return import_urdf.run(args)
    if args.capture is None:
        raise InputError(f"import {args.kind}", "", "no --capture", "--capture FILE.csv, the capture to write")
    samples = IMPORTERS[args.kind](args.source, args.capture)
    # What a simulation of the same name left would pass for the truth of a measurement.
    truth_path(args.capture).unlink(missing_ok=True)
    show(report_console(args.json), f"capture: {args.capture}, {samples} samples")
    if args.json:
        print(json_text({"schema": "sms-online/import/1", "capture": str(args.capture), "samples": samples}))
    return OK
