"""bound: the least standard deviation that any unbiased estimator can reach with a motion and a set of sensors."""

from __future__ import annotations

import argparse
import math
from functools import partial

from rich.table import Table

from sms_adapters.sources import open_source
from sms_online.session import Recorded
from sms_sim.bound import Bounds, bound
from sms_tools.exit_codes import NOTHING_DETERMINED, OK
from sms_tools.report import report_console, show
from sms_tools.session import described_system
from sms_tools.waiting import waiting, watched


def run(args: argparse.Namespace) -> int:
    """Print the bound of every parameter; 0, 3 where the motion determines none."""
    system, folder = described_system(args)
    if args.capture is None:
        with waiting() as progress:
            bounds = bound(system, grade=args.grade, each_sensor=args.each_sensor, progress=progress)
    else:
        opened = partial(open_source, args.capture, system, None, None, directory=folder)
        with watched(args.capture, lambda moved: opened(on_bytes=moved)) as reading:
            recorded = Recorded(reading, str(args.capture))
            bounds = bound(system, recorded, grade=args.grade, each_sensor=args.each_sensor)
    console = report_console(args.json)
    if bounds.grade != args.grade:
        show(console, f"noise: grade {bounds.grade}, for {args.system} does not state that of every sensor")
    show(console, _table(bounds))
    if args.json:
        print(bounds.to_json())
    determined = any(math.isfinite(parameter.std) for parameter in bounds.parameters.values())
    return OK if determined else NOTHING_DETERMINED


def _table(bounds: Bounds) -> Table:
    headings, rows = bounds.rows()
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column(headings[0], overflow="fold")
    table.add_column(headings[1])
    for heading in headings[2:]:
        table.add_column(heading, justify="right")
    for cells in rows:
        table.add_row(*cells)
    return table
