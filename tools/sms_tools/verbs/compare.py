"""compare: each parameter over sessions of one rig, and what has changed."""

from __future__ import annotations

import argparse

from sms_adapters.runs import compare
from sms_tools.exit_codes import OK
from sms_tools.report import say, table
from sms_tools.results_file import results_directory, write_document

NAME = "comparison.json"


def run(args: argparse.Namespace) -> int:
    """Compare results; 0, whether or not something has changed."""
    directory = results_directory(args.out)
    compared = compare(args.runs)
    path = write_document(directory / NAME, compared.to_json())
    from sms_tools.html_report.comparison_page import write_comparison  # Matplotlib takes a second to be imported

    page = write_comparison(directory, compared)
    shown = table(*compared.rows(), left=("parameter", "unit", "changed sessions"))
    lines = [f"comparison: {path}", f"page: {page}", "", compared.sentence]
    say(args, shown, "", *lines, document=compared.to_json())
    return OK
