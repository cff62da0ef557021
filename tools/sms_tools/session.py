"""What replay and demo share: a session streamed through the estimator, and what is made of its end."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np
from rich.table import Table

from sms_adapters.system_file import load_system
from sms_online.description.schema import System
from sms_online.diagnosis.online import OnlineDiagnosis
from sms_online.errors import InputError
from sms_online.judgement import Discrepancy
from sms_online.pipeline.estimator import Estimator
from sms_online.results import results_document
from sms_online.stream import Array, Block
from sms_tools.adopted_system import ONLINE_NAME, adopted_text, remarks, write_adopted
from sms_tools.exit_codes import INTERRUPTED, NOTHING_DETERMINED, OK
from sms_tools.interruption import Interruption
from sms_tools.priors import base_prior
from sms_tools.report import Document, parameter_table, report_console, show, trust_lines
from sms_tools.results_file import to_json, write_results

# Effects of one cause that a warning names.
NAMED = 4


def described_system(args: argparse.Namespace) -> tuple[System, Path | None]:
    """The system asked for, and the directory of its file, where its DBC stands too; None for a shipped one."""
    system = load_system(args.system)
    path = Path(args.system)
    return system, path.parent if path.suffix == ".toml" else None


def check_part(args: argparse.Namespace) -> None:
    """InputError where -to is not after -ss."""
    if args.stop is not None and args.start is not None and args.stop <= args.start:
        raise InputError("-to", "", f"{args.stop:g} s", f"a time after -ss {args.start:g} s")


def new_estimator(system: System, channels: tuple[str, ...], source: str, nominal_prior: bool = False) -> Estimator:
    """The estimator of a session, with the system file's priors; nominal_prior: see `base_prior`."""
    estimator = Estimator(system, channels, source)
    if nominal_prior or system.priors:
        # A prior is on the base parameters, which the estimator has found.
        estimator.set_prior(base_prior(system, estimator.base, nominal_prior))
    return estimator


def stream(
    estimator: Estimator, blocks: Iterable[Block], interruption: Interruption, after: Callable[[], None] | None = None
) -> float:
    """Push the blocks until they or the person's patience end, then finish; seconds spent in the estimator.

    after: called when a block is through.
    """
    busy = 0.0
    for block in blocks:
        start = perf_counter()
        estimator.push(block)
        busy += perf_counter() - start
        if after is not None:
            after()
        if interruption.requested:
            break
    start = perf_counter()
    estimator.finish()
    estimator.estimate()
    return busy + perf_counter() - start


def conclude(args: argparse.Namespace, document: Document, directory: Path, interrupted: bool) -> int:
    """Write results.json, print it for people or programs, and say how the session ended."""
    if interrupted:
        document["warnings"].append("interrupted: this is what the samples until then say")
    console = report_console(args.json)
    parts: list[Table | str] = [parameter_table(document, console.width), "", *trust_lines(document)]
    try:
        path = write_results(directory, document)
    except InputError:
        # A disk that refuses the file must not take the numbers with it.
        show(console, *parts)
        raise
    show(console, *parts, f"results: {path}")
    if args.json:
        print(to_json(document))
    if interrupted:
        return INTERRUPTED
    return OK if any(p["identifiable"] for p in document["parameters"]) else NOTHING_DETERMINED


def write_named(args: argparse.Namespace, online: OnlineDiagnosis, directory: Path) -> None:
    """With --adopt, the system file with what was named, if anything was."""
    system = online.system
    described = load_system(args.system)
    if args.adopt and system != described:
        found = [effect for episode in online.document() for effect in episode["effects"]]
        path = write_adopted(directory, adopted_text(args.system, described, system, remarks(found)), ONLINE_NAME)
        show(report_console(args.json), f"system file with what was found: {path}")


def unstated_latency(estimator: Estimator) -> list[str]:
    """That a source is late against the others by more than the system file says, if one is."""
    found = None if estimator.momentum is None else estimator.momentum.latencies.found
    if found is None:
        return []
    late = f"{1e3 * abs(found.size):.3g} ± {1e3 * found.std:.2g} ms"
    if found.size < 0.0:
        return [f"all sources but {found.source}: {late} later than their stated latencies"]
    more = [f"{len(found.effects) - NAMED} more"] if len(found.effects) > NAMED else []
    effects = ", ".join([*found.effects[:NAMED], *more])
    return [f"{found.source}: {late} later than its stated latency ({effects})"]


def document_of(
    estimator: Estimator,
    throughput: float,
    warnings: list[str],
    truth: dict[str, float] | None,
    bound: Array | None = None,
    discrepancies: Sequence[Discrepancy] = (),
) -> Document:
    """results.json of a session, with what the synchroniser and the sensing noticed among its warnings.

    discrepancies: of the diagnosis beside it.
    """
    counters = estimator.counters
    noticed = []
    if estimator.dropped_rows:
        noticed.append(f"{estimator.dropped_rows} rows of the balance dropped: a value in them is beyond all numbers")
    period = 1.0 / estimator.system.sample_rate
    fastest = float(np.nanmin(estimator.periods, initial=np.inf))
    if np.isfinite(fastest) and not 0.8 < fastest / period < 1.25:
        noticed.append(
            f"the capture has {1.0 / fastest:.4g} samples/s, the system file says {estimator.system.sample_rate:g}"
        )
    late = [name for sensor in estimator.system.sensors if sensor.latency > 0.0 for name in sensor.channels]
    if late:
        noticed.append(f"latency of {', '.join(late)} is described but not corrected")
    if counters.gaps:
        noticed.append(f"{counters.gaps} gaps too long to bridge; each begins a new window of the balance")
    if counters.interpolated_cells:
        noticed.append(f"{counters.interpolated_cells} cells interpolated")
    noticed += unstated_latency(estimator)
    if estimator.unused:
        noticed.append(f"channels not used: {', '.join(estimator.unused)}")
    names = [parameter.name for parameter in estimator.base.physical]
    if truth is not None and not truth.keys() >= set(names):
        missing = next(name for name in names if name not in truth)
        noticed.append(f"no comparison with the truth: it does not hold {missing}")
        truth = None
    return results_document(estimator, throughput, [*warnings, *noticed], truth, bound, discrepancies)
