"""The momentum balance, from samples to estimate: samples a second of one core, and memory. Run on demand.

pytest tests/bench/test_bench_momentum.py --override-ini addopts= -s
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from time import process_time

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Block
from sms_sim.plant import Plant
from sms_sim.simulate import sampled_blocks, simulate
from tests.prescribed_motion import prescribed
from tests.sessions_of import session_of
from tests.test_base_parameters import right_angled

# Live at the arm's own rate asks for 250 samples/s, replay of the planar example for 4,000.
SESSIONS = [
    ("paper-planar", 20.0, 1000.0),
    ("spatial-two-link", 10.0, 1000.0),
    ("seven-joint", 10.0, 1000.0),
    ("seven-joint", 10.0, 250.0),
    ("emps", 5.0, 1000.0),
]
# A rigid arm of six axes, s and Hz, and noise of its encoders, rad, and torques, N m.
SIX_AXES, FAST, NOISE = 9.0, 5000.0, (1e-5, 0.05)


def recorded(name: str, seconds: float, rate: float) -> tuple[System, list[Block]]:
    """A described system at a sample rate, and what its sensors record at grade B."""
    system = load_system(name).model_copy(update={"sample_rate": rate})
    return system, list(sampled_blocks(simulate(system, seconds), "B", seed=1))


def estimated(system: System, blocks: list[Block]) -> Estimator:
    """The full recipe: noise estimated, energy and momentum rows, weights, bias, calibration within tolerances."""
    estimator = session_of(system, blocks)
    estimator.estimate()
    return estimator


@pytest.mark.parametrize(("name", "seconds", "rate"), SESSIONS)
def test_samples_a_second(name: str, seconds: float, rate: float) -> None:
    """Best of three by processor time."""
    system, blocks = recorded(name, seconds, rate)
    samples = sum(block.t.size for block in blocks)
    best = float("inf")
    for _ in range(3):
        start = process_time()
        estimator = estimated(system, blocks)
        best = min(best, process_time() - start)
    assert estimator.by_momentum
    windows = 0 if estimator.momentum is None else estimator.momentum.joint.grams.windows
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


def six_axes() -> tuple[System, tuple[str, ...], Block]:
    """A rigid arm of six axes at 5 kHz along sines of all joints."""
    system = right_angled("three parallel axes").model_copy(update={"sample_rate": FAST})
    model, plant = build_model(system), Plant(system)
    rng = np.random.default_rng(1)
    motion = prescribed(model, round(SIX_AXES * FAST), seed=1)
    values = plant.channel_values(motion.Q[:, list(model.layout.theta_m)], motion.x)
    sigma = np.array([NOISE[1] if name.startswith("tau_") else NOISE[0] for name in plant.channels])
    return system, plant.channels, Block(motion.t, plant.channels, values + sigma * rng.standard_normal(values.shape))


def test_a_rigid_arm_of_six_axes_at_5_khz(tmp_path: Path) -> None:
    """In a process of its own, whose memory holds nothing else."""
    system, channels, block = six_axes()
    (tmp_path / "system.json").write_text(system.model_dump_json())
    np.savez(tmp_path / "block.npz", t=block.t, values=block.values)
    program = (
        "import re, sys, time; import numpy as np; import sms_online as sms; "
        "from sms_online.description.schema import System; "
        "system = System.model_validate_json(open(sys.argv[1] + '/system.json').read()); "
        "block = np.load(sys.argv[1] + '/block.npz'); t, values = block['t'], block['values']; "
        "columns = {name: values[:, k] for k, name in enumerate(sys.argv[2].split(','))}; "
        "start = time.process_time(); sms.estimate(system, sms.Capture.from_arrays(t, columns)); "
        # What getrusage says would hold the memory of this process, which the other was forked from.
        "peak = re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1]; "
        "print(time.process_time() - start, int(peak) / 1024)"
    )
    command = [sys.executable, "-c", program, str(tmp_path), ",".join(channels)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    seconds, peak = map(float, done.stdout.split())
    print(f"\nsix axes: {block.t.size} samples, {block.t.size / seconds:,.0f} samples/s, peak {peak:.0f} MB")
