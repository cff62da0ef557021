"""replay: a recorded session through the estimator, as fast as it goes or in step with its clock."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from time import perf_counter

from sms_adapters.data_check import ChannelChecks, Checked
from sms_adapters.recorded import recorded_at
from sms_online.capture import PIECE
from sms_online.cramer_rao import session_bound
from sms_online.errors import InputError
from sms_online.session import session_of
from sms_online.stream import Block
from sms_tools.interruption import Interruption
from sms_tools.results_file import results_directory
from sms_tools.session import check_part, conclude, described_system, feed, write_named
from sms_tools.showing import showing
from sms_tools.waiting import watched

# In step with the clock, a push holds so much of the session, s.
PACE = 0.05


def run(args: argparse.Namespace) -> int:
    """Replay a capture; 0, 3 where nothing is determined, 130 where interrupted."""
    check_part(args)
    system, folder = described_system(args)
    directory = results_directory(args.out)
    capture: Path = args.capture
    opened = perf_counter()
    with Interruption() as interruption:
        with watched(capture, system, folder, args.start, args.stop) as reading:
            source = reading.source
            recorded = recorded_at(capture, source, whole=args.start is args.stop is None)
            session, record = session_of(system, recorded, args.prior, args.adopt, args.bound, args.tracker)
            patient = args.speed == "max"
            rows = PIECE if patient else max(1, round(PACE * system.sample_rate))
            pieces = (piece for block in reading for piece in block.pieces(rows))
            blocks = pieces if patient else _paced(pieces, interruption)
            say = partial(reading.console.print, soft_wrap=True)
            checks = ChannelChecks(system, source.channels)
            checked = Checked(checks, lambda line: say(f"check: {line}"))
            watched_blocks = _in_seconds(checked.watch(blocks), checks, capture)
            with showing(args, session, directory, recorded.truth, patient) as shown:
                shown.follow(say)
                feed(session, shown.watch(watched_blocks), interruption)
                wall = perf_counter() - opened
        bound = None if record is None else session_bound(session.estimator, record)
        warnings = [*source.warnings, *checked.warnings, *shown.warnings]
        result = session.evaluate(recorded.truth, bound, warnings, session.estimator.samples / wall)
        write_named(args, session, directory)
        code = conclude(args, result, directory, interruption.requested)
        shown.report(result, interruption)
    return code


def _in_seconds(blocks: Iterable[Block], checks: ChannelChecks, capture: Path) -> Iterator[Block]:
    """The same blocks; InputError where stamps are in another unit: samples between would be interpolated."""
    for block in blocks:
        if (unit := checks.other_unit_of_time) is not None:
            raise InputError(str(capture), "t", f"stamps in {unit}", f's, or stamp_unit = "{unit}" under a [[source]]')
        yield block


def _paced(blocks: Iterable[Block], interruption: Interruption) -> Iterator[Block]:
    """Each block when its last sample is due, counted from the first."""
    start = perf_counter()
    first: float | None = None
    for block in blocks:
        first = float(block.t[0]) if first is None else first
        interruption.sleep(start + float(block.t[-1]) - first - perf_counter())
        yield block
