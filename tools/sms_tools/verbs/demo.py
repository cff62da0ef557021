"""demo: an arm moves in simulation, and its parameters converge while it does."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from statistics import median
from time import perf_counter

from rich.console import Console
from rich.live import Live

from sms_online.pipeline.estimator import Estimator
from sms_sim.live import LivePlant
from sms_tools.interruption import Interruption
from sms_tools.report import Document, parameter_table, report_console, show
from sms_tools.results_file import results_directory
from sms_tools.session import conclude, described_system, document_of, new_estimator, stream

# More tables than this nobody reads, s between two.
TABLE_INTERVAL = 0.25
# Where there is no terminal to draw on: a line each so many seconds of motion.
LINE_INTERVAL = 2.0


def run(args: argparse.Namespace) -> int:
    """Simulate and estimate side by side; 0, 3 where nothing is determined, 130 where interrupted."""
    system, _ = described_system(args)
    directory = results_directory(args.out)
    plant = LivePlant(system, args.grade, args.seed)
    estimator = new_estimator(system, plant.channels, system.name)
    # The simulated arm has the nominal values.
    truth = {parameter.name: parameter.nominal for parameter in estimator.base.physical}

    def document(throughput: float) -> Document:
        return document_of(estimator, throughput, plant.warnings, truth)

    console = report_console(args.json)
    with Interruption() as interruption:
        if console.is_terminal:
            with Live(console=console, auto_refresh=False, transient=True) as live:
                busy = stream(estimator, plant, interruption, _draw(live, document, plant.duration))
        else:
            busy = stream(estimator, plant, interruption, _tell(console, estimator, document))
    # The simulation's time is not the estimator's.
    return conclude(args, document(estimator.samples / busy), directory, interruption.requested)


def _draw(live: Live, document: Callable[[float], Document], duration: float) -> Callable[[], None]:
    """Keeps a table up to date."""
    drawn = -math.inf

    def draw() -> None:
        nonlocal drawn
        if perf_counter() - drawn >= TABLE_INTERVAL:
            now = document(0.0)
            title = f"{now['system']['title']}: {now['duration_s']:.1f} of {duration:g} s"
            live.update(parameter_table(now, live.console.width, title), refresh=True)
            drawn = perf_counter()

    return draw


def _tell(console: Console, estimator: Estimator, document: Callable[[float], Document]) -> Callable[[], None]:
    """Says now and then how far it has come."""
    told = 0.0

    def tell() -> None:
        nonlocal told
        if estimator.duration >= told + LINE_INTERVAL:
            told = estimator.duration
            parameters = document(0.0)["parameters"]
            determined = [p for p in parameters if p["identifiable"]]
            line = f"{told:5.1f} s: {len(determined)} of {len(parameters)} parameters determined"
            errors = [abs(p["estimate"] / p["true"] - 1.0) for p in determined if p["true"]]
            if errors:
                line += f", errors {100.0 * median(errors):.2g} % (median), {100.0 * max(errors):.2g} % (largest)"
            show(console, line)

    return tell
