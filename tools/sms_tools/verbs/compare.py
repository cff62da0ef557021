"""compare: each parameter over sessions of one rig, and what has changed."""

from __future__ import annotations

import argparse

from rich.table import Table

from sms_adapters.runs import compare
from sms_tools.exit_codes import OK
from sms_tools.report import report_console, show
from sms_tools.results_file import results_directory, write_document

NAME = "comparison.json"


def run(args: argparse.Namespace) -> int:
    """Compare results; 0, whether or not something has changed."""
    directory = results_directory(args.out)
    compared = compare(args.runs)
    path = write_document(directory / NAME, compared.to_json())
    from sms_tools.html_report.comparison_page import write_comparison  # Matplotlib takes a second to be imported

    page = write_comparison(directory, compared)
    headings, rows = compared.rows()
    table = Table(box=None, header_style="bold", pad_edge=False)
    for heading in headings:
        right = heading in ("reference", "spread %")
        table.add_column(heading, justify="right" if right else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console = report_console(args.json)
    show(console, table, "", f"comparison: {path}", f"page: {page}", "", compared.sentence)
    if args.json:
        print(compared.to_json())
    return OK
