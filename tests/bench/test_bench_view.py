"""What a view costs: its hand-over in the estimator's thread, and an hour replayed with a recording. Run on demand.

pytest tests/bench/test_bench_view.py --override-ini addopts= -s
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from time import perf_counter, process_time, sleep, thread_time

import numpy as np
import pytest

from sms_adapters.capture import CaptureWriter
from sms_adapters.system_file import load_system
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Block
from sms_sim.simulate import sampled_blocks, simulate
from sms_tools.view.session import View, open_view

# Of the long replay: MINUTES in the environment, an hour by default, which takes nine minutes twice.
ROWS = round(float(os.environ.get("MINUTES", "60")) * 60_000)
GAP = 0.1  # s between repetitions of a motion, a gap that the synchroniser sees
# Samples that a live source delivers at a time.
DELIVERED = 10


@pytest.mark.parametrize("name", ["paper-planar", "seven-joint"])
def test_hand_over(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """1 kHz data in step with the clock: time that the estimator's thread spends on the view."""
    system = load_system(name)
    blocks = list(sampled_blocks(simulate(system, 10.0), "B", seed=1))
    estimator = Estimator(system, blocks[0].channels, "bench")
    took: list[float] = []
    spent = 0.0
    show = View._show

    def timed(view: View, blocks: tuple[Block, ...], with_state: bool) -> None:
        nonlocal spent
        cpu, start = thread_time(), perf_counter()
        show(view, blocks, with_state)
        took.append(1e3 * (perf_counter() - start))
        spent += thread_time() - cpu

    monkeypatch.setattr(View, "_show", timed)
    with open_view("save", estimator, blocks[0].channels, tmp_path) as view:
        begun = perf_counter()
        source = (
            Block(b.t[k : k + DELIVERED], b.channels, b.values[k : k + DELIVERED])
            for b in blocks
            for k in range(0, b.t.size, DELIVERED)
        )
        for block in view.watch(source):
            sleep(max(0.0, begun + float(block.t[-1]) - perf_counter()))
            estimator.push(block)
        wall = perf_counter() - begun
    p50, p99 = np.quantile(took, [0.5, 0.99])
    print(
        f"\n{name}: {len(took)} hand-overs in {wall:.1f} s, p50 {p50:.3f} ms, p99 {p99:.3f} ms, "
        f"maximum {max(took):.3f} ms; {100.0 * spent / wall:.2f} % of a core; "
        f"process {process_time():.1f} s; dropped {view.warnings}"
    )


def test_an_hour(tmp_path: Path) -> None:
    """An hour at 1 kHz with a recording and without: time, memory of both processes, size of the file."""
    system = load_system("paper-planar")
    blocks = list(sampled_blocks(simulate(system, 20.0), "B", seed=1))
    capture = tmp_path / "hour.csv"
    with CaptureWriter(capture, blocks[0].channels) as writer:
        for k in range(-(-ROWS // sum(block.t.size for block in blocks))):
            for block in blocks:
                writer.write(Block(block.t + k * (20.0 + GAP), block.channels, block.values))
    wall = {}
    for choice in ("off", "save"):
        program = (
            "import resource, sys; from sms_tools.cli import main; "
            f"code = main(['replay', {str(capture)!r}, '--system', 'paper-planar', '--out', {str(tmp_path)!r}, "
            f"'--rerun', {choice!r}]); "
            "peaks = [resource.getrusage(who).ru_maxrss / 1024 for who in (resource.RUSAGE_SELF, "
            "resource.RUSAGE_CHILDREN)]; print('peaks', *peaks); sys.exit(code)"
        )
        start = perf_counter()
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
        wall[choice] = perf_counter() - start
        own, view = done.stdout.rsplit("peaks", 1)[1].split()
        print(f"\n--rerun {choice}: {wall[choice]:.1f} s, peak {own} MB, view's process {view} MB", done.stderr)
    recording = tmp_path / "session.rrd"
    print(f"ratio {wall['save'] / wall['off']:.2f}, recording {recording.stat().st_size / 1e6:.1f} MB")
    subprocess.run([str(Path(sys.executable).with_name("rerun")), "rrd", "verify", str(recording)], check=True)
