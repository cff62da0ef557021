"""The momentum balance, from samples to estimate: samples a second of one core. Run on demand.

pytest tests/bench/test_bench_momentum.py --override-ini addopts= -s
"""

from __future__ import annotations

from time import process_time

import pytest

from sms_adapters.system_file import load_system
from sms_online.description.schema import System
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Block
from sms_sim.simulate import sampled_blocks, simulate

# Live at the arm's own rate asks for 250 samples/s, replay of the planar example for 4,000.
SESSIONS = [("paper-planar", 20.0, 1000.0), ("seven-joint", 10.0, 250.0)]


def recorded(name: str, seconds: float, rate: float) -> tuple[System, list[Block]]:
    """A described system at a sample rate, and what its sensors record at grade B."""
    system = load_system(name).model_copy(update={"sample_rate": rate})
    return system, list(sampled_blocks(simulate(system, seconds), "B", seed=1))


@pytest.mark.parametrize(("name", "seconds", "rate"), SESSIONS)
def test_samples_a_second(name: str, seconds: float, rate: float) -> None:
    """The full recipe: noise estimated, energy and momentum rows, weights, bias; best of three by processor time."""
    system, blocks = recorded(name, seconds, rate)
    samples = sum(block.t.size for block in blocks)
    best = float("inf")
    for _ in range(3):
        estimator = Estimator(system, blocks[0].channels, "bench")
        start = process_time()
        for block in blocks:
            estimator.push(block)
        estimator.finish()
        estimator.estimate()
        best = min(best, process_time() - start)
    assert estimator.by_momentum
    windows = 0 if estimator.momentum is None else estimator.momentum.grams.windows
    print(f"\n{name}: {samples} samples, {windows} windows, {samples / best:,.0f} samples/s ({best:.2f} s)")


@pytest.mark.parametrize(("name", "seconds", "rate"), SESSIONS)
def test_longest_block(name: str, seconds: float, rate: float) -> None:
    """Live: what the slowest block costs, one sample pushed at a time."""
    system, blocks = recorded(name, seconds, rate)
    estimator = Estimator(system, blocks[0].channels, "bench")
    took = []
    for block in blocks:
        for sample in block.pieces(1):
            start = process_time()
            estimator.push(sample)
            took.append(process_time() - start)
    print(f"\n{name}: longest push {1e3 * max(took):.0f} ms, {sum(took) / (len(took) / rate):.2f} of the time used")
