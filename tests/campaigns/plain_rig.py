"""A plain rig without slopes: errors of the smoother over many sessions, beside the bound of that very sensor set.

    python -m tests.campaigns.plain_rig run RESULTS.jsonl --runs 20
    python -m tests.campaigns.plain_rig summary RESULTS.jsonl

The planar example with 17-bit encoders and a gyro at 1 kHz, markers that read displacements alone and the base's pose
at 240 Hz. Every session is a line of RESULTS.jsonl: `run` may be stopped at any time and goes on where it was. Nominal
values that the estimator sees are not the true ones, and nothing is a prior.
"""

from __future__ import annotations

import json
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.evaluation import NORMAL_95
from sms_online.model.base_parameters import find_base_parameters
from sms_online.stream import Block
from sms_sim.sensors import Sensors
from sms_sim.simulate import simulate
from tests.campaigns.results import Record, append, campaign, read
from tests.campaigns.sessions import disguised, exact_session, true_parameters
from tests.evaluated import standard_deviation
from tests.plain_rig import bound_of, plain_rig
from tests.sessions_of import session_of

# Asked of each parameter: an error within so many times the bound.
ASKED = 10.0


def noisy(system: System, exact: Block, seed: int) -> Block:
    """What the described sensors make of exact samples."""
    return Block(exact.t, exact.channels, Sensors(system, exact.channels, None, seed).read(0, exact.values))


def one_session(system: System, block: Block) -> Record:
    """Estimate of one session."""
    start = process_time()
    estimator = session_of(disguised(system), [block])
    smoother = estimator.smoother
    assert smoother is not None
    return {
        "estimate": estimator.estimate().pi.tolist(),
        "std": standard_deviation(estimator).tolist(),
        "by_smoother": estimator.by_smoother,
        "mean_square": smoother.mean_square,
        "failures": smoother.failures,
        "seconds": process_time() - start,
    }


def run(results: Path, runs: int) -> None:
    """Append the sessions that `results` lacks, seed by seed."""
    system = plain_rig()
    exact = exact_session(system, results.with_suffix(".exact.npz"))
    limit = results.with_suffix(".bound.json")
    if not limit.exists():
        limit.write_text(json.dumps(bound_of(simulate(system)).tolist()), encoding="utf-8")
    done = {record["seed"] for record in read(results)}
    for seed in range(runs):
        if seed not in done:
            record = one_session(system, noisy(system, exact, seed))
            append(results, {"seed": seed, **record})


def summary(results: Path) -> str:
    """Errors beside the bound; an exclamation mark where an error is beyond what is asked."""
    records: list[dict[str, Any]] = read(results)
    limit = np.array(json.loads(results.with_suffix(".bound.json").read_text(encoding="utf-8")))
    system = plain_rig()
    truth, names = true_parameters(system), [p.name for p in find_base_parameters(build_model(system)).parameters]
    estimate, std = (np.array([record[key] for record in records]) for key in ("estimate", "std"))
    error = np.abs(estimate - truth)
    ratio, normalised = error / limit, (estimate - truth) / std
    lines = [f"{'parameter':34}{'bound %':>10}{'median %':>10}{'ratio':>8}{'worst':>8}{'σ/bound':>9}{'rms z':>8}"]
    for k, name in enumerate(names):
        worst = float(ratio[:, k].max())
        lines.append(
            f"{name:34}{100.0 * limit[k] / abs(truth[k]):10.4f}{100.0 * np.median(error[:, k]) / abs(truth[k]):10.4f}"
            f"{np.median(ratio[:, k]):8.2f}{worst:7.2f}{'!' if worst > ASKED else ' '}"
            f"{np.median(std[:, k]) / limit[k]:9.2f}{np.sqrt(np.mean(normalised[:, k] ** 2)):8.2f}"
        )
    covered = 100.0 * float((np.abs(normalised) < NORMAL_95).mean())
    seconds = np.median([record["seconds"] for record in records])
    smoothed = sum(record["by_smoother"] for record in records)
    lines += [
        f"95 % intervals cover {covered:.1f} % pooled",
        f"{smoothed} of {len(records)} sessions by the smoother, {seconds:.1f} s of one core a session",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    campaign(
        __doc__,
        {"run": lambda args: run(args.results, args.runs), "summary": lambda args: summary(args.results)},
        runs={"type": int, "default": 20, "help": "seeds 0, 1, …, 20 by default"},
    )
