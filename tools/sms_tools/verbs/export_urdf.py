"""export: estimates into the URDF that a system file was imported from."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sms_adapters.files import read_json, write_text
from sms_adapters.urdf_export import export_urdf
from sms_online.description.explain import explain
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_tools.exit_codes import NOTHING_DETERMINED, OK
from sms_tools.report import report_console, say, show


def run(args: argparse.Namespace) -> int:
    """Write the URDF; 3 where the session has determined nothing, and nothing is written."""
    system, estimates = _results(args.results)
    if not estimates:
        show(report_console(args.json), f"{args.results}: no parameter is determined, so there is nothing to export")
        return NOTHING_DETERMINED
    exported = export_urdf(args.source, system, estimates)
    write_text(args.out, exported.text)
    lines = [f"URDF: {args.out}, {len(estimates)} estimates, {len(exported.links)} links"]
    if exported.impossible:
        names = ", ".join(exported.impossible)
        lines.append(f"warning: no body has the inertial of {names}; identify on a motion that excites more")
    document = {"schema": "sms-online/export/1", "urdf": str(args.out), "links": exported.links}
    say(args, *lines, document=document | {"joints": exported.joints, "impossible": exported.impossible})
    return OK


def _results(path: Path) -> tuple[System, dict[str, float]]:
    """System of a results.json and the estimates of what was determined."""
    document: dict[str, Any] = read_json(path, "a results.json")
    try:
        system = System.model_validate_json(json.dumps(document["system"]))
        parameters = [p for p in document["parameters"] if p["identifiable"]]
        return system, {p["name"]: float(p["estimate"]) for p in parameters}
    except ValidationError as error:
        raise explain(error, str(path)) from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(str(path), "", f"{type(error).__name__}: {error}", "a results.json of sms-online") from None
