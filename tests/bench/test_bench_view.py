"""What a view costs: its hand-over in the estimator's thread, and an hour replayed with a recording. Run on demand.

pytest tests/bench/test_bench_view.py --override-ini addopts= -s
"""

from __future__ import annotations

import os
import resource
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

# Of the long replay: MINUTES in the environment, an hour by default, which takes a quarter of an hour twice.
ROWS = round(float(os.environ.get("MINUTES", "60")) * 60_000)
# Rows over the seconds between two looks at the memory: of an hour every 30 s.
SAMPLED_ROWS = 120_000.0
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
        for block in view.watch(piece for delivered in blocks for piece in delivered.pieces(DELIVERED)):
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
    """An hour at 1 kHz without and with a recording: both processes' time and memory as it goes, size of the file."""
    system = load_system("paper-planar")
    blocks = list(sampled_blocks(simulate(system, 20.0), "B", seed=1))
    capture = tmp_path / "hour.csv"
    with CaptureWriter(capture, blocks[0].channels) as writer:
        for k in range(-(-ROWS // sum(block.t.size for block in blocks))):
            for block in blocks:
                writer.write(Block(block.t + k * (20.0 + GAP), block.channels, block.values))
    recording = tmp_path / "session.rrd"
    wall, cpu = {}, {}
    for choice in ("off", "save"):
        program = (
            "import resource, sys; from sms_tools.cli import main; "
            f"code = main(['replay', {str(capture)!r}, '--system', 'paper-planar', '--out', {str(tmp_path)!r}, "
            f"'--rerun', {choice!r}]); "
            "used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]; "
            "print('cpu', *(u.ru_utime + u.ru_stime for u in used)); sys.exit(code)"
        )
        start = perf_counter()
        with (tmp_path / f"{choice}.txt").open("w+") as out:
            replay = subprocess.Popen([sys.executable, "-c", program], stdout=out, stderr=subprocess.STDOUT)
            while replay.poll() is None:
                size = recording.stat().st_size / 1e6 if recording.exists() else 0.0
                print(
                    f"{choice} {perf_counter() - start:6.0f} s: memory {_memory(replay.pid)} MB, "
                    f"recording {size:.1f} MB",
                    flush=True,
                )
                try:
                    replay.wait(ROWS / SAMPLED_ROWS)
                except subprocess.TimeoutExpired:
                    continue
            wall[choice] = perf_counter() - start
            out.seek(0)
            output = out.read()
        assert replay.returncode == 0, output
        own, view = map(float, output.rsplit("cpu", 1)[1].split())
        cpu[choice] = own
        print(
            f"--rerun {choice}: {wall[choice]:.1f} s, CPU {own:.1f} s and {view:.1f} s of the view\n{output}",
            flush=True,
        )
    print(
        f"ratio {wall['save'] / wall['off']:.2f} by the clock, {cpu['save'] / cpu['off']:.2f} by the estimator's CPU "
        f"time; recording {recording.stat().st_size / 1e6:.1f} MB"
    )
    subprocess.run([str(Path(sys.executable).with_name("rerun")), "rrd", "verify", str(recording)], check=True)


def _memory(process: int) -> list[int]:
    """Resident memory, MB, of a process and its children; an ended one is left out."""
    found = []
    for member in (process, *_children(process)):
        try:
            pages = int(Path(f"/proc/{member}/statm").read_text().split()[1])
        except OSError:
            continue
        found.append(round(pages * resource.getpagesize() / 1e6))
    return found


def _children(process: int) -> list[int]:
    done = subprocess.run(["ps", "-o", "pid=", "--ppid", str(process)], capture_output=True, text=True, check=False)
    return [int(word) for word in done.stdout.split()]
