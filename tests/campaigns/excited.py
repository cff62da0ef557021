"""Designed motions of the planar example within its own motion's extremes and duration, from seeded starts.

    python -m tests.campaigns.excited run RESULTS.jsonl --seeds 10
    python -m tests.campaigns.excited fact RESULTS.jsonl --noises 20
    python -m tests.campaigns.excited summary RESULTS.jsonl

By how much the median and the largest of the relative Cramér–Rao bounds are lower than with the described motion; and,
with the best of them, the errors of sessions at grade B. A start takes some five minutes of a core, a session
of either motion ten seconds.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from time import process_time

import numpy as np

import sms_online as sms
from sms_adapters.system_file import load_system
from sms_online.description.schema import System, Trajectory
from sms_online.effects.build import build_model
from sms_online.errors import InputError
from sms_online.model.base_parameters import find_base_parameters
from sms_sim.bound import Bounds
from sms_sim.excitation import ITERATIONS, excite
from tests.campaigns.results import Record, campaign, complete, read, summed
from tests.campaigns.sessions import exact_session, noisy_session, true_parameters

SYSTEM, GRADE = "paper-planar", "B"
DESCRIBED, DESIGNED = MOTIONS = ("described", "designed")


def relative(bounds: Bounds) -> list[float]:
    """Bounds in per cent of their values, of all parameters that are not nominally zero."""
    return [math.inf if p.percent is None else p.percent for p in bounds.parameters.values() if p.value]


def gain(record: Record, which: str) -> float:
    """By how much the median or the worst bound is lower."""
    before, after = record[which]
    return float(before / after)


def starts(records: list[Record]) -> list[Record]:
    """The records of designs, the best of the worst parameter first."""
    return sorted((r for r in records if "worst" in r), key=lambda r: -gain(r, "worst"))


def run(args: argparse.Namespace) -> None:
    """Append the starts that the results lack."""
    steps = args.iterations
    complete(args, start, [({"seed": seed, "iterations": steps}, (seed, steps)) for seed in range(args.seeds)])


def start(seed: int, iterations: int) -> Record:
    """The design of one seeded start."""
    system = load_system(SYSTEM)
    began = process_time()
    found = excite(system, seed=seed, grade=GRADE, iterations=iterations)
    assert found.before is not None
    assert found.system.trajectory is not None
    shares = [relative(bounds) for bounds in (found.before, found.after)]
    return {
        "kept": found.system == system,
        "median": [float(np.median(s)) for s in shares],
        "worst": [max(s) for s in shares],
        "trajectory": found.system.trajectory.model_dump(mode="json"),
        "seconds": process_time() - began,
    }


def fact(args: argparse.Namespace) -> None:
    """Append errors of sessions with the described motion and with the best designed one."""
    ordered = starts(read(args.results))
    if not ordered:
        raise InputError(str(args.results), "", "no start", "the results of run")
    best = ordered[0]
    tasks = []
    for motion, system in ((DESCRIBED, load_system(SYSTEM)), (DESIGNED, designed(load_system(SYSTEM), best))):
        cache = args.results.with_suffix(f".{motion}.npz")
        exact_session(system, cache)
        names = {"motion": motion, "design": best["seed"]}
        tasks += [({**names, "noise": noise}, (cache, system, noise)) for noise in range(args.noises)]
    complete(args, session, tasks)


def session(cache: Path, system: System, noise: int) -> Record:
    """Errors of one session, % of each parameter's value."""
    block = noisy_session(system, exact_session(system, cache), GRADE, noise)
    result = sms.estimate(system, sms.Capture(block.t, block.channels, block.values))
    names = [p.name for p in find_base_parameters(build_model(system)).parameters]
    truth = dict(zip(names, true_parameters(system).tolist(), strict=True))
    errors = {p.name: 100.0 * abs(p.value - truth[p.name]) / truth[p.name] for p in result.parameters.values()}
    return {"errors": errors, "trust": result.trust.level}


def designed(system: System, record: Record) -> System:
    """The system with a design's motion."""
    return system.model_copy(update={"trajectory": Trajectory.model_validate(record["trajectory"])})


def summary(records: list[Record]) -> str:
    """A line for each start, and what the best does."""
    ordered = starts(records)
    lines = [
        f"seed {r['seed']}: median {gain(r, 'median'):.2f}, worst {gain(r, 'worst'):.2f} times lower"
        + (", the described motion kept" if r["kept"] else "")
        for r in sorted(ordered, key=lambda r: int(r["seed"]))
    ]
    if ordered:
        best = ordered[0]
        lines.append(
            f"best of {len(ordered)}: seed {best['seed']}, median {gain(best, 'median'):.2f}, "
            f"worst {gain(best, 'worst'):.2f} times lower"
        )
    sessions = {
        motion: [r for r in records if r.get("motion") == motion and r["design"] == ordered[0]["seed"]]
        for motion in MOTIONS
    }
    if all(sessions.values()):
        rms = {motion: errors(own) for motion, own in sessions.items()}
        counts = ", ".join(f"{len(own)} {motion}" for motion, own in sessions.items())
        factors = [float(np.median(rms[m])) for m in MOTIONS], [max(rms[m]) for m in MOTIONS]
        median, worst = (before / after for before, after in factors)
        trusted = sum(r["trust"] == "trust" for own in sessions.values() for r in own)
        lines.append(
            f"in fact, rms errors of {counts} sessions: median {median:.2f}, worst {worst:.2f} times lower; "
            f"{trusted} of them trusted"
        )
    return "\n".join(lines)


def errors(sessions: list[Record]) -> list[float]:
    """Root mean square error of each parameter over sessions, % of its value."""
    names = list(sessions[0]["errors"])
    return [float(np.sqrt(np.mean([r["errors"][name] ** 2 for r in sessions]))) for name in names]


if __name__ == "__main__":
    campaign(
        __doc__,
        {"run": run, "fact": fact, "summary": summed(summary)},
        seeds={"type": int, "default": 10},
        noises={"type": int, "default": 20},
        iterations={"type": int, "default": ITERATIONS},
    )
