"""import: a published measurement, or any log that a system file describes, as a capture; a URDF as a system file."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

from sms_adapters.camera_capture import import_points
from sms_adapters.files import write_text
from sms_adapters.importers import import_emps, import_quanser
from sms_adapters.mcap_capture import capture_writer
from sms_adapters.sources import open_source
from sms_adapters.truth import truth_path
from sms_adapters.urdf import import_urdf
from sms_online.errors import InputError
from sms_tools.exit_codes import OK
from sms_tools.report import say
from sms_tools.session import described_system
from sms_tools.waiting import watched

# Writes the capture of a source; number of its samples, what was skipped, and what was found.
Importer = Callable[[argparse.Namespace], tuple[int, list[str], list[str]]]


def run(args: argparse.Namespace) -> int:
    """Write the capture and say how long it is, or the system file of a URDF."""
    if args.beside is not None and args.kind != "points":
        raise InputError(
            f"import {args.kind}", "--beside", f"{args.beside}", "import points, which joins two recordings"
        )
    if args.kind == "urdf":
        return _urdf(args)
    if args.capture is None:
        raise InputError(f"import {args.kind}", "", "no --capture", "--capture FILE, the capture to write")
    if args.capture.resolve() == args.source.resolve():
        raise InputError(f"import {args.kind}", "--capture", f"{args.capture}, the source itself", "another file")
    samples, warnings, found = KINDS[args.kind](args)
    # What a simulation of the same name left would pass for the truth of a measurement.
    truth_path(args.capture).unlink(missing_ok=True)
    lines = [f"warning: {warning}" for warning in warnings]
    document = {
        "schema": "sms-online/import/1", "capture": str(args.capture), "samples": samples, "warnings": warnings,
        "found": found,
    }  # fmt: skip
    say(args, f"capture: {args.capture}, {samples} samples", *found, *lines, document=document)
    return OK


def _urdf(args: argparse.Namespace) -> int:
    """Write the system file of a URDF; InputError where there is one already, which somebody may have completed."""
    path = args.source.with_suffix(".toml") if args.out is None else args.out
    if path.exists():
        raise InputError(str(path), "", "a file of this name", "--out with the name of a file that is not there yet")
    write_text(path, import_urdf(args.source))
    document = {"schema": "sms-online/import-urdf/1", "system": str(path)}
    say(args, f"system file: {path}; its first lines say what is to be completed", document=document)
    return OK


def _published(convert: Callable[[Path, Path], int], args: argparse.Namespace) -> tuple[int, list[str], list[str]]:
    return convert(args.source, args.capture), [], []


def _log(args: argparse.Namespace) -> tuple[int, list[str], list[str]]:
    """Any log that `replay` reads."""
    if args.system is None:
        raise InputError("import log", "", "no --system", "the system file, which says what the log's numbers are")
    system, folder = described_system(args)
    samples = 0
    with (
        watched(args.source, system, folder) as reading,
        capture_writer(args.capture, tuple(reading.channels)) as writer,
    ):
        for block in reading:
            writer.write(block)
            samples += block.t.size
    return samples, list(reading.warnings), []


def _points(args: argparse.Namespace) -> tuple[int, list[str], list[str]]:
    """Points of a motion capture's file, alone or with what drives recorded meanwhile."""
    if args.system is None:
        raise InputError("import points", "", "no --system", "the system file, whose markers have names")
    system, folder = described_system(args)
    if args.beside is None:
        return import_points(args.source, system, args.capture)
    drives = open_source(args.beside, system, directory=folder)
    return import_points(args.source, system, args.capture, drives)


KINDS: dict[str, Importer] = {
    "emps": partial(_published, import_emps),
    "quanser": partial(_published, import_quanser),
    "log": _log,
    "points": _points,
}
