"""live: the testbed of a system file, estimated while it moves, and recorded."""

from __future__ import annotations

import argparse
import math
from contextlib import closing

from sms_online.diagnosis.online import OnlineDiagnosis
from sms_tools.exit_codes import INTERRUPTED
from sms_tools.interruption import Interruption
from sms_tools.live.searches import SearchProcess
from sms_tools.live.signals import termination_interrupts
from sms_tools.live.status import StatusWriter
from sms_tools.live.testbed import open_testbed
from sms_tools.report import report_console, show
from sms_tools.results_file import results_directory
from sms_tools.session import conclude, described_system, document_of, write_named
from sms_tools.showing import showing


def run(args: argparse.Namespace) -> int:
    """Read, record and estimate until interrupted; 130 then, 0 or 3 at the end of --duration."""
    system, folder = described_system(args)
    directory = results_directory(args.out)
    status = StatusWriter()
    session, estimator, merger = open_testbed(args.system, system, folder, directory, args.resume, status)
    with Interruption() as interruption, termination_interrupts():
        with (
            showing(args, estimator, merger.channels, directory, None, live=session) as shown,
            closing(SearchProcess(directory, args.adopt)) as searches,
        ):
            online = OnlineDiagnosis(estimator, searches, args.adopt)
            session.discrepancies = lambda: online.discrepancies
            session.notices = lambda: [*online.notices, *shown.notices]
            shown.follow(online)
            blocks = session.blocks(interruption, math.inf if args.duration is None else args.duration)
            for block in shown.watch(blocks):
                estimator.push(block)
            estimator.finish()
            online.finish()
        session.close()
        status.close()
        throughput = estimator.samples / session.busy if session.busy else 0.0
        warnings = [*merger.warnings, *session.warnings, *shown.warnings]
        warnings += [] if searches.problem is None else [searches.problem]
        document = document_of(estimator, throughput, warnings, None, discrepancies=online.discrepancies)
        document["diagnosis"] = online.document()
        write_named(args, online, directory)
        code = conclude(args, document, directory, interrupted=False)
        half, nearly_all = session.latencies.quantile(0.5), session.latencies.quantile(0.99)
        if half is not None and nearly_all is not None:
            latency = f"median {1e3 * half:.0f} ms, p99 {1e3 * nearly_all:.0f} ms, over the last seconds"
            show(report_console(args.json), f"latency, arrival to estimate: {latency}")
        shown.report(document, interruption)
    # That is how a session without an end ends, and no reason to doubt its results.
    return INTERRUPTED if interruption.requested else code
