"""Designed motions of the planar example within its own motion's extremes and duration, from seeded starts.

    python -m tests.campaigns.excited run RESULTS.jsonl --seeds 10
    python -m tests.campaigns.excited summary RESULTS.jsonl

By how much the median and the largest of the relative Cramér–Rao bounds are lower than with the described motion. A
start takes some five minutes of a quiet core.
"""

from __future__ import annotations

import argparse
import math
from time import process_time

import numpy as np

from sms_adapters.system_file import load_system
from sms_sim.bound import Bounds
from sms_sim.excitation import excite
from tests.campaigns.results import Record, append, campaign, read, summed

SYSTEM = "paper-planar"


def relative(bounds: Bounds) -> list[float]:
    """Bounds in per cent of their values, of all parameters that are not nominally zero."""
    return [math.inf if p.percent is None else p.percent for p in bounds.parameters.values() if p.value]


def run(args: argparse.Namespace) -> None:
    """Append the starts that the results lack."""
    done = {record["seed"] for record in read(args.results)}
    system = load_system(SYSTEM)
    for seed in range(args.seeds):
        if seed in done:
            continue
        began = process_time()
        found = excite(system, seed=seed, iterations=args.iterations)
        assert found.before is not None
        shares = [relative(bounds) for bounds in (found.before, found.after)]
        record = {"seed": seed, "iterations": args.iterations, "kept": found.system == system}
        record |= {"median": [float(np.median(s)) for s in shares], "worst": [max(s) for s in shares]}
        append(args.results, record | {"seconds": process_time() - began})


def summary(records: list[Record]) -> str:
    """A line for each start, and the best of them."""

    def gain(record: Record, which: str) -> float:
        before, after = record[which]
        return float(before / after)

    lines = [
        f"seed {r['seed']}: median {gain(r, 'median'):.2f}, worst {gain(r, 'worst'):.2f} times lower"
        + (", the described motion kept" if r["kept"] else "")
        for r in records
    ]
    if records:
        best = max(records, key=lambda r: gain(r, "worst"))
        lines.append(
            f"best of {len(records)}: seed {best['seed']}, median {gain(best, 'median'):.2f}, "
            f"worst {gain(best, 'worst'):.2f} times lower"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    campaign(
        __doc__,
        {"run": run, "summary": summed(summary)},
        seeds={"type": int, "default": 10},
        iterations={"type": int, "default": 15},
    )
