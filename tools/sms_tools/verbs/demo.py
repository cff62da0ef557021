"""demo: an arm moves on a simulated bus, and its parameters converge while it does."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from sms_adapters.session_log import SESSION
from sms_adapters.system_file import load_system
from sms_adapters.truth import write_truth
from sms_online.session import Session, with_trackers
from sms_tools.interruption import Interruption
from sms_tools.live.searches import SearchProcess
from sms_tools.live.simulated import SimulatedArm, write_testbed
from sms_tools.live.testbed import open_testbed
from sms_tools.report import parameter_table, report_console, show, verdict_text
from sms_tools.results_file import results_directory
from sms_tools.session import conclude, described_system
from sms_tools.showing import showing

# More tables than this nobody reads, s between two.
TABLE_INTERVAL = 0.25
# Where there is no terminal to draw on: a line each so many seconds of motion.
LINE_INTERVAL = 2.0


def run(args: argparse.Namespace) -> int:
    """An arm on a simulated bus, estimated live; 0, 3 where nothing is determined, 130 where interrupted."""
    system, _ = described_system(args)
    directory = results_directory(args.out)
    with TemporaryDirectory() as name:
        folder = Path(name)
        file = write_testbed(args.system, system, args.grade, folder)
        noise = [] if args.grade is None else ["--grade", args.grade]
        arm = SimulatedArm(file, [*noise, "--seed", str(args.seed)])
        try:
            return _watch(args, arm, file, directory)
        finally:
            arm.stop()


def _watch(args: argparse.Namespace, arm: SimulatedArm, file: Path, directory: Path) -> int:
    """Estimate while the arm moves."""
    system = with_trackers(load_system(str(file)), args.tracker)
    live, session, merger = open_testbed(str(file), system, file.parent, directory)
    # The simulated arm has the nominal values.
    truth = {"parameters": {parameter.name: parameter.nominal for parameter in session.estimator.base.physical}}
    write_truth(directory / SESSION, truth["parameters"], {})
    console = report_console(args.json)
    show(console, Text("solving the arm's motion ahead …", style="dim"))
    with Interruption() as interruption, ExitStack() as stack:
        shown = stack.enter_context(showing(args, session, directory, truth, live=live))
        searches = stack.enter_context(closing(SearchProcess(directory, adopt=False)))
        session.diagnosis.searcher = searches
        shown.follow()
        if console.is_terminal:
            drawn = stack.enter_context(Live(console=console, auto_refresh=False, transient=True))
            assert system.trajectory is not None  # the arm moves
            show_progress = _draw(drawn, session, truth, system.trajectory.duration)
        else:
            show_progress = _say(console, session, truth)
        for block in shown.watch(live.blocks(interruption, ended=arm.ended, ready=arm.start)):
            session.update(block)
            show_progress()
        session.finish()
        live.close()
        stack.close()
        warnings = [*merger.warnings, *live.warnings, *shown.warnings]
        warnings += [] if searches.problem is None else [searches.problem]
        result = session.evaluate(truth, None, warnings, session.estimator.samples / live.busy)
        code = conclude(args, result, directory, interruption.requested)
        shown.report(result, interruption)
    return code


def _draw(live: Live, session: Session, truth: Mapping[str, Any], duration: float) -> Callable[[], None]:
    """Keeps a table up to date."""
    drawn = -math.inf

    def draw() -> None:
        nonlocal drawn
        if perf_counter() - drawn >= TABLE_INTERVAL:
            now = session.evaluate(truth).document()
            title = f"{now['system']['title']}: {now['duration_s']:.1f} of {duration:g} s"
            table = parameter_table(now, live.console.width, title)
            # Before it has converged an estimate may be off by any number of its bars.
            table.style = "dim" if now["verdict"]["level"] == "not yet" else ""
            live.update(Group(table, verdict_text(now["verdict"])), refresh=True)
            drawn = perf_counter()

    return draw


def _say(console: Console, session: Session, truth: Mapping[str, Any]) -> Callable[[], None]:
    """Says now and then how far it has come."""
    said = 0.0

    def say() -> None:
        nonlocal said
        if session.estimator.duration >= said + LINE_INTERVAL:
            said = session.estimator.duration
            now = session.evaluate(truth)
            determined = [p for p in now.parameters.values() if p.determined]
            line = f"{said:5.1f} s: {len(determined)} of {len(now.parameters)} parameters determined"
            errors = [abs(p.value / p.true - 1.0) for p in determined if p.true]
            if errors:
                line += f", errors {100.0 * median(errors):.2g} % (median), {100.0 * max(errors):.2g} % (largest)"
            show(console, f"{line}; {now.trust.sentence}")

    return say
