"""live: the testbed of a system file, estimated while it moves, and recorded."""

from __future__ import annotations

import argparse
import math
from contextlib import closing

from sms_adapters.data_check import ChannelChecks, Checked
from sms_tools.exit_codes import INTERRUPTED
from sms_tools.interruption import Interruption
from sms_tools.live.searches import SearchProcess
from sms_tools.live.status import StatusWriter
from sms_tools.live.testbed import open_testbed
from sms_tools.report import report_console, show
from sms_tools.results_file import results_directory
from sms_tools.session import conclude, described_system, write_named
from sms_tools.showing import showing


def run(args: argparse.Namespace) -> int:
    """Read, record and estimate until interrupted; 130 then, 0 or 3 at the end of --duration."""
    system, folder = described_system(args)
    directory = results_directory(args.out)
    status = StatusWriter()
    live, session, merger = open_testbed(args.system, system, folder, directory, args.resume, status, args.adopt)
    with Interruption() as interruption:
        with (
            showing(args, session, directory, None, live=live) as shown,
            closing(SearchProcess(directory, args.adopt)) as searches,
        ):
            session.diagnosis.searcher = searches
            checked = Checked(ChannelChecks(system, session.channels))
            live.notices = lambda: [*session.diagnosis.notices, *shown.notices, *checked.warnings]
            shown.follow()
            blocks = live.blocks(interruption, math.inf if args.duration is None else args.duration)
            for block in shown.watch(checked.watch(blocks)):
                session.update(block)
            session.finish()
        live.close()
        status.close()
        throughput = session.estimator.samples / live.busy if live.busy else 0.0
        warnings = [*merger.warnings, *live.warnings, *checked.warnings, *shown.warnings]
        warnings += [] if searches.problem is None else [searches.problem]
        result = session.evaluate(None, None, warnings, throughput)
        write_named(args, session, directory)
        code = conclude(args, result, directory, interrupted=False)
        half, nearly_all = live.latencies.quantile(0.5), live.latencies.quantile(0.99)
        if half is not None and nearly_all is not None:
            latency = f"median {1e3 * half:.0f} ms, p99 {1e3 * nearly_all:.0f} ms, over the last seconds"
            show(report_console(args.json), f"latency, arrival to estimate: {latency}")
        shown.report(result, interruption)
    # That is how a session without an end ends, and no reason to doubt its results.
    return INTERRUPTED if interruption.requested else code
