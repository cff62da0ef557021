"""Whole sessions: replay from file to results, single pushes, an hour of samples. Run on demand on one core.

pytest tests/bench/test_bench_session.py --override-ini addopts= -s
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from sms_adapters.capture import CaptureWriter
from sms_adapters.sources import open_source
from sms_adapters.system_file import load_system
from sms_online.description.bodies import FlexibleLink
from sms_online.description.schema import System
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Block
from sms_sim.simulate import sampled_blocks, simulate

HOUR = 3_600_000
GAP = 0.1  # s between repetitions of a motion, a gap that the synchroniser sees


def with_three_elements(system: System) -> System:
    """The same arm with three elements in every flexible link."""
    links = [
        link.model_copy(update={"elements": 3}) if isinstance(link, FlexibleLink) else link for link in system.links
    ]
    return system.model_copy(update={"links": tuple(links)})


def session(system: System, capture: Path) -> Estimator:
    """A capture, from file to estimate."""
    source = open_source(capture, system, None, None, None)
    estimator = Estimator(system, source.channels, str(capture))
    for block in source:
        estimator.push(block)
    estimator.finish()
    estimator.estimate()
    return estimator


def repeated(blocks: list[Block], times: int) -> Iterator[Block]:
    """A motion again and again, with gaps between."""
    period = blocks[-1].t[-1] + GAP
    for k in range(times):
        for block in blocks:
            yield Block(block.t + k * period, block.channels, block.values)


@pytest.mark.parametrize(("name", "seconds", "times"), [("paper-planar", 20.0, 10), ("seven-joint", 4.0, 5)])
def test_replay(benchmark: BenchmarkFixture, tmp_path: Path, name: str, seconds: float, times: int) -> None:
    system = with_three_elements(load_system(name))
    if name == "paper-planar":
        system = load_system(name)
    blocks = list(sampled_blocks(simulate(system, seconds), "B", seed=1))
    with CaptureWriter(tmp_path / "run.csv", blocks[0].channels) as writer:
        for block in repeated(blocks, times):
            writer.write(block)
    estimator = benchmark.pedantic(session, args=(system, tmp_path / "run.csv"), rounds=5, warmup_rounds=1)
    rate = estimator.samples / benchmark.stats.stats.min
    print(f"\n{name}: {estimator.samples} samples, best {rate:,.0f} samples/s")
    benchmark.extra_info["samples_per_second"] = rate


@pytest.mark.parametrize("grade", ["0", "B"])
def test_single_pushes(grade: str) -> None:
    system = load_system("paper-planar")
    blocks = list(sampled_blocks(simulate(system, 20.0), grade, seed=1))
    estimator = Estimator(system, blocks[0].channels, "bench")
    took = []
    for block in blocks:
        for sample in block.pieces(1):
            start = perf_counter()
            estimator.push(sample)
            took.append(1e3 * (perf_counter() - start))
    p50, p99 = np.quantile(took, [0.5, 0.99])
    print(f"\ngrade {grade}: push p50 {p50:.4f} ms, p99 {p99:.4f} ms, maximum {max(took):.2f} ms")


def test_an_hour(tmp_path: Path) -> None:
    """3.6 million rows: memory of a process that replays the file, and π against the same rows pushed as one block."""
    system = load_system("paper-planar")
    blocks = list(sampled_blocks(simulate(system, 20.0), "B", seed=1))
    capture = tmp_path / "hour.csv"
    times = -(-HOUR // sum(block.t.size for block in blocks))
    with CaptureWriter(capture, blocks[0].channels) as writer:
        for block in repeated(blocks, times):
            writer.write(block)
    program = (
        "import resource, sys; from sms_tools.cli import main; "
        f"code = main(['replay', {str(capture)!r}, '--system', 'paper-planar', '--out', {str(tmp_path)!r}]); "
        "print('peak MB', resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024); sys.exit(code)"
    )
    start = perf_counter()
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    peak = float(done.stdout.rsplit("peak MB", 1)[1])
    print(f"\n{times * 20001} rows in {perf_counter() - start:.0f} s, peak {peak:.0f} MB")
    streamed = session(system, capture).estimate().pi
    everything = list(repeated(blocks, times))
    whole = Estimator(system, blocks[0].channels, "bench")
    whole.push(
        Block(
            np.concatenate([block.t for block in everything]),
            blocks[0].channels,
            np.concatenate([block.values for block in everything]),
        )
    )
    whole.finish()
    print("same bits as in one block:", np.array_equal(streamed, whole.estimate().pi))
    assert np.array_equal(streamed, whole.estimate().pi)
