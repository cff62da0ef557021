"""validate: what known parameters leave of the torques and deflections of another run."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.table import Table

from sms_adapters.runs import NAME as RESULTS
from sms_adapters.runs import read_results
from sms_adapters.session_log import SYSTEM
from sms_online.calibration.found import Calibration
from sms_online.description.schema import System
from sms_online.recorded import Recorded
from sms_online.result import Parameter, Parameters
from sms_online.validation import validate
from sms_tools.exit_codes import OK
from sms_tools.report import say, table
from sms_tools.results_file import results_directory, write_document
from sms_tools.session import check_part, described_system
from sms_tools.waiting import watched

NAME = "validation.json"


def run(args: argparse.Namespace) -> int:
    """Validate; 0, whether or not the parameters hold."""
    check_part(args)
    system, parameters, calibration, folder = _described(args)
    directory = results_directory(args.out)
    with watched(args.capture, system, folder, args.start, args.stop) as reading:
        found = validate(system, Recorded(reading, str(args.capture)), parameters, calibration)
    path = write_document(directory / NAME, found.to_json())
    from sms_tools.html_report.validation_page import write_validation  # Matplotlib takes a second to be imported

    page = write_validation(directory, found)
    tables: list[Table | str] = [table(*found.rows(), left=("joint",)), ""]
    if found.deflections:
        tables += [table(*found.deflection_rows(), left=("deflection",)), ""]
    warnings = [f"warning: {warning}" for warning in found.warnings]
    files = [f"validation: {path}", f"page: {page}"]
    say(args, *tables, *warnings, *files, "", found.sentence, document=found.to_json())
    return OK


def _described(args: argparse.Namespace) -> tuple[System, Parameters | None, list[Calibration], Path | None]:
    """System, parameters and calibration of a results.json or of a run's folder; of a system file nominal values."""
    path = Path(args.system)
    if path.is_dir() and (path / SYSTEM).exists() and not (path / RESULTS).exists():
        # The folder of a diagnosis.
        path = path / SYSTEM
        args.system = str(path)
    if path.suffix != ".json" and not path.is_dir():
        system, folder = described_system(args)
        return system, None, [], folder
    document = read_results(path)
    values = Parameters(Parameter.of(p | {"std": p["std"] or None}) for p in document["parameters"])
    calibration = [Calibration(**each) for each in document["calibration"]]
    return System.model_validate(document["system"]), values, calibration, None
