"""archive: every capture under a folder identified and diagnosed, one table, with resume."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sms_tools.archive.captures import ROWS, TABLE, archive
from sms_tools.archive.rows import Row
from sms_tools.exit_codes import NOTHING_DETERMINED, OK
from sms_tools.report import report_console, say
from sms_tools.results_file import RUNS, results_directory
from sms_tools.session import described_system


def run(args: argparse.Namespace) -> int:
    """Identify and diagnose what is not yet in the table; 0, 3 where no capture determines a parameter."""
    system, folder = described_system(args)
    # The same folder every time, so that the next run goes on.
    out = results_directory(args.out or RUNS / f"archive-{Path(args.folder).absolute().name}")
    console = report_console(args.json)
    columns = (TextColumn("captures"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("captures", total=None)

        def note(row: Row, done: int, of: int) -> None:
            progress.update(task, completed=done, total=of)
            text = f"{row['capture']}: {row['error'] or row['summary']}"
            progress.console.print(text, soft_wrap=True)

        rows = archive(args.folder, system, folder, out, workers=args.workers, scheduler=args.scheduler, progress=note)
    counts = Counter(row.get("verdict") or "failed" for row in rows)
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items()))
    document = {"schema": "sms-online/archive/1", "system": system.name, "table": str(out / TABLE), "rows": rows}
    files = [f"table: {out / TABLE}", f"rows: {out / ROWS}"]
    say(args, "", f"{len(rows)} captures: {verdicts}", *files, document=document)
    return OK if any(row.get("parameters") for row in rows) else NOTHING_DETERMINED
