"""A plain rig without slopes: errors of the smoother over many sessions, beside the bound of that very sensor set.

    python -m tests.campaigns.plain_rig run RESULTS.jsonl --runs 20
    python -m tests.campaigns.plain_rig summary RESULTS.jsonl

The planar example with 17-bit encoders and a gyro at 1 kHz, markers that read displacements alone and the base's pose
at 240 Hz. Every session is a line of RESULTS.jsonl: `run` may be stopped at any time and goes on where it was. Nominal
values that the estimator sees are not the true ones, and nothing is a prior.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from time import process_time

import numpy as np

from sms_online.effects.build import build_model
from sms_online.evaluation import NORMAL_95
from sms_online.model.base_parameters import find_base_parameters
from sms_online.stream import Array
from sms_sim.simulate import simulate
from tests.campaigns.results import Record, campaign, complete, summed
from tests.campaigns.sessions import cached_bound, disguised, exact_session, noisy_session, true_parameters
from tests.evaluated import standard_deviation
from tests.plain_rig import bound_of, plain_rig
from tests.sessions_of import session_of

# Asked of each parameter: an error within so many times the bound.
ASKED = 10.0


def run(args: argparse.Namespace) -> None:
    """Append the sessions that the results lack, seed by seed."""
    cache = args.results.with_suffix(".exact.npz")
    exact_session(plain_rig(), cache)
    limit(args.results)
    complete(args, one_session, [({"seed": seed}, (cache, seed)) for seed in range(args.runs)])


def limit(results: Path) -> Array:
    """The bound (n,), kept beside the results."""
    return cached_bound(results.with_suffix(".bound.json"), lambda: bound_of(simulate(plain_rig())))


def one_session(cache: Path, seed: int) -> Record:
    """Estimate of one session."""
    system = plain_rig()
    block = noisy_session(system, exact_session(system, cache), None, seed)
    start = process_time()
    estimator = session_of(disguised(system), [block])
    smoother = estimator.smoother
    assert smoother is not None
    return {
        "estimate": estimator.estimate().pi.tolist(),
        "std": standard_deviation(estimator).tolist(),
        "by_smoother": estimator.by_smoother,
        "mean_square": smoother.known.mean_square,
        "failures": smoother.known.failures,
        "seconds": process_time() - start,
    }


def summary(records: list[Record], limit: Array) -> str:
    """Errors beside the bound; an exclamation mark where an error is beyond what is asked."""
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
        {"run": run, "summary": lambda args: summed(partial(summary, limit=limit(args.results)))(args)},
        runs={"type": int, "default": 20, "help": "seeds 0, 1, …, 20 by default"},
    )
