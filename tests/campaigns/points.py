"""Sessions of an arm that cameras see as points: coverage, errors and error bars against the bound.

    python -m tests.campaigns.points run RESULTS.jsonl --seeds 50 [--system NAME] [--faults] [--off]
    python -m tests.campaigns.points summary RESULTS.jsonl

Every session is a line of RESULTS.jsonl: `run` may be stopped at any time and goes on where it was.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from sms_online.effects.build import build_model
from sms_online.evaluation import NORMAL_95
from sms_online.stream import Array
from sms_sim.camera_faults import CameraFaults, parsed_faults
from sms_sim.simulate import simulate
from tests.camera_rig import FAULTS, bound_of, readings_off, seen_by_cameras
from tests.campaigns.results import Record, campaign, complete, summed
from tests.campaigns.sessions import cached_bound, exact_session, noisy_session
from tests.sessions_of import session_of


def run(args: argparse.Namespace) -> None:
    """Append the sessions that the results lack, seed by seed."""
    system = seen_by_cameras(args.system)
    cache = args.results.with_suffix(f".{args.system}.npz")
    exact_session(system, cache)
    bound = cached_bound(cache.with_suffix(".bound.json"), lambda: bound_of(simulate(system)))
    names = {"system": args.system, "faults": args.faults} | ({"off": True} if args.off else {})
    settings = (cache, bound, args.system, args.faults, args.off)
    tasks = [({**names, "seed": seed}, (*settings, seed)) for seed in range(args.seeds)]
    complete(args, one_session, tasks)


def one_session(cache: Path, bound: Array, name: str, faulty: bool, off: bool, seed: int) -> Record:
    """z of each parameter, and its standard deviation as a multiple of the bound."""
    system = seen_by_cameras(name)
    block = noisy_session(system, exact_session(system, cache), None, seed)
    faults = CameraFaults(parsed_faults(FAULTS if faulty else ()), block.channels, seed)
    truth = build_model(system).nominal
    block = faults(block)
    if off:
        system, block = readings_off(system, block, seed)
    estimator = session_of(system, [block])
    estimate = estimator.estimate()
    return {
        "method": estimator.method,
        "z": ((estimate.pi - estimator.base.values(truth)) / estimate.std).tolist(),
        "std": (estimator.estimate().std / bound).tolist(),
        "swaps": len(estimator.swaps),
    }


def _kind(record: Record) -> tuple[str, bool, bool]:
    return record["system"], record["faults"], record.get("off", False)


def summary(records: list[Record]) -> str:
    """Coverage of 95 % intervals, rms of z, and of errors over the bound, the worst parameter's too."""
    lines = []
    for system, faults, off in dict.fromkeys(map(_kind, records)):
        own = [record for record in records if _kind(record) == (system, faults, off)]
        z, std = (np.array([record[name] for record in own]) for name in ("z", "std"))
        rms = np.sqrt(np.mean((z * std) ** 2, axis=0))
        by_smoother = sum(record["method"] == "smoother" for record in own)
        lines += [
            f"{len(own)} sessions of {system}{' with faults' if faults else ''}{', readings off' if off else ''}, "
            f"{by_smoother} by the smoother",
            f"coverage {np.mean(np.abs(z) < NORMAL_95):.3f}, rms z {np.sqrt(np.mean(z**2)):.2f}",
            f"errors over the bound: rms {np.sqrt(np.mean(rms**2)):.2f}, of the worst parameter {rms.max():.2f}",
            f"error bars over the bound: {std.min():.2f} to {std.max():.2f}",
        ]
    return "\n".join(lines)


if __name__ == "__main__":
    campaign(
        __doc__,
        {"run": run, "summary": summed(summary)},
        seeds={"type": int, "default": 50},
        system={"default": "paper-planar", "help": "a shipped system"},
        faults={"action": "store_true", "help": "markers missing, hidden and swapped"},
        off={"action": "store_true", "help": "readings and description off within the default tolerances"},
    )
