"""import urdf: a URDF as a system file; rigid parts filled in, the rest marked to be completed."""

from __future__ import annotations

import argparse

from sms_adapters.urdf import import_urdf
from sms_online.errors import InputError
from sms_tools.exit_codes import OK
from sms_tools.report import say


def run(args: argparse.Namespace) -> int:
    """Write the system file; InputError where there is one already, which somebody may have completed."""
    path = args.source.with_suffix(".toml") if args.out is None else args.out
    if path.exists():
        raise InputError(str(path), "", "a file of this name", "--out with the name of a file that is not there yet")
    path.write_text(import_urdf(args.source), encoding="utf-8")
    document = {"schema": "sms-online/import-urdf/1", "system": str(path)}
    say(args, f"system file: {path}; its first lines say what is to be completed", document=document)
    return OK
