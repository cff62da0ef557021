"""A minute live on the simulated bus, effects that begin meanwhile, hours of the arm and a day of one axis at once.

Run on demand, the hours at full speed: pytest tests/bench/test_bench_live.py --override-ini addopts= -s
"""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest

from sms_adapters.capture import CaptureWriter
from sms_adapters.checkpoint import write_checkpoint
from sms_adapters.clock_lanes import merger
from sms_adapters.clock_merge import TICK
from sms_adapters.raw import CanFrames, Raw, SerialChunk, concatenate_frames
from sms_adapters.recording import tick_time
from sms_adapters.system_file import load_system
from sms_online.checkpoint import Checkpoint
from sms_online.description.parse import shipped_text
from sms_online.description.schema import System
from sms_online.effects.catalogue import parse_effect
from sms_online.pipeline.estimator import Estimator
from sms_online.session import Session
from sms_online.stream import Array, Block
from sms_sim.bus_encode import DeviceClock, devices
from sms_sim.bus_layout import messages
from sms_sim.bus_motion import MovingArm
from sms_sim.plant import Plant
from sms_sim.sensors import Sensors
from sms_sim.simulate import simulate
from sms_tools.html_report.course import CourseRecorder
from sms_tools.live.simulated import SimulatedArm, write_testbed
from tests.axis import AXIS, DAMPING, INERTIA
from tests.changed_session import changed_session
from tests.evaluated import standard_deviation

# Length of a repetition, s: 20 s of motion and a pause.
PERIOD = 20.5
# Noise of grade B, the base and the markers at 240 Hz.
SENSORS = {
    '["tau_*"]': "noise = 0.01",
    '["theta_m_*", "q_*"]': "noise = 1e-4",
    '["r_S_*", "theta_0"]': "noise = 1e-4\nrate = 240.0",
    '["link_*.marker_*.u_*", "link_*.marker_*.theta_z"]': "noise = 1e-4\nrate = 240.0",
}


def bench_system(folder: Path) -> tuple[Path, System]:
    """The paper's example on a simulated bus, its latency stated."""
    text = shipped_text("paper-planar")
    for channels, keys in SENSORS.items():
        text = text.replace(f"channels = {channels}", f"channels = {channels}\n{keys}")
    (folder / "paper.toml").write_text(text)
    system = load_system(str(folder / "paper.toml"))
    path = write_testbed(str(folder / "paper.toml"), system, None, folder)
    path.write_text(re.sub(r'(kind = "(can|serial)"\n)', r"\1latency = 0.004\n", path.read_text()))
    return path, load_system(str(path))


def arm_capture(system: System, seconds: float, path: Path) -> Path:
    """The arm's samples, solved beforehand so that two processes share two cores."""
    arm = MovingArm(system, seconds, None, 1)
    with CaptureWriter(path, arm.channels) as writer:
        for block in arm:
            writer.write(block)
    return path


@pytest.mark.parametrize("seconds", [60.0])
def test_a_minute_live(tmp_path: Path, seconds: float) -> None:
    file, system = bench_system(tmp_path)
    capture = arm_capture(system, seconds, tmp_path / "arm.csv")
    arm = SimulatedArm(file, ["--capture", str(capture), "--latency", "0.004", "--duration", str(seconds)])
    command = [sys.executable, "-m", "sms_tools", "live", "--system", str(file), "--out", str(tmp_path / "run")]
    process = subprocess.Popen([*command, "--duration", str(seconds + 8)], stdout=subprocess.PIPE, text=True)
    time.sleep(5.0)
    began = cpu(process.pid)
    arm.start()
    time.sleep(seconds)
    share = (cpu(process.pid) - began) / seconds
    assert process.stdout is not None
    out = process.stdout.read()
    process.wait()
    arm.stop()
    document = json.loads((tmp_path / "run" / "results.json").read_text())
    print(f"\nestimator process: {100 * share:.0f} % of a core")
    print("\n".join(line for line in out.splitlines() if line.startswith(("latency", "samples", "warning"))))
    gaps = [warning for warning in document["warnings"] if "gaps too long" in warning]
    # Without a gap they are those before the first and behind the last full stencil of the slowest channel.
    print(f"lost samples: {document['lost_samples']}, {gaps[0] if gaps else 'none of them inside'}")


# When an effect begins, and how long the session lasts, s.
BEGIN, END = 8.0, 18.0


@pytest.mark.parametrize(
    "text", ["coulomb_friction@joint_1:torque=2", "air_drag@base:damping=60", "cubic_stiffness@joint_1:stiffness=300"]
)
def test_an_effect_that_begins_live(tmp_path: Path, text: str) -> None:
    """When it is noticed and named, by the clock of the session: what searches take counts."""
    file, system = bench_system(tmp_path)
    exact = changed_session(
        simulate(system, END),
        system.model_copy(update={"effects": (*system.effects, parse_effect(text, system))}),
        BEGIN,
        END,
    )
    sensors = Sensors(system, exact.channels, None, 1)
    with CaptureWriter(tmp_path / "arm.csv", sensors.channels) as writer:
        writer.write(Block(exact.t, sensors.channels, sensors.read(0, exact.values)))
    arm = SimulatedArm(file, ["--capture", str(tmp_path / "arm.csv"), "--latency", "0.004", "--duration", str(END)])
    command = [sys.executable, "-m", "sms_tools", "live", "--system", str(file), "--out", str(tmp_path / "run")]
    process = subprocess.Popen([*command, "--duration", str(END + 8)], stdout=subprocess.DEVNULL)
    try:
        time.sleep(5.0)
        arm.start()
        assert process.wait(timeout=5 * END) == 0
    finally:
        process.kill()
        arm.stop()
    # The session's clock runs since before the arm moved; its first frame is that of t = 0.
    first = float((tmp_path / "run" / "can.log").read_text().partition(")")[0].removeprefix("("))
    epoch = tomllib.loads((tmp_path / "run" / "session.toml").read_text())["epoch_us"]
    begin = first - 1e-6 * epoch - 0.004 + BEGIN
    document = json.loads((tmp_path / "run" / "results.json").read_text())
    print(f"\n{text}, {document['duration_s']:.2f} of {END:g} s used")
    assert document["diagnosis"]
    for episode in document["diagnosis"]:
        named = "not named" if episode["named"] is None else f"named after {episode['named'] - begin:.2f}"
        print(f"noticed after {episode['noticed'] - begin:.2f}, {named} s: {episode['summary']}")


def cpu(pid: int) -> float:
    """Seconds of processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Devices:
    """Raw items of the bus, block by block, with delays up to 2 ms."""

    def __init__(self, system: System, folder: Path) -> None:
        (self._can,), self._serial = devices(system, folder, [DeviceClock(0.3, 5e-5)] * len(system.sources))
        self._random = np.random.default_rng(1)

    def items(self, block: Block) -> list[list[Raw]]:
        """What each source delivers of a block."""
        frames = []
        for t, part in self._can.encode(block):
            frames.append(CanFrames(self._arrival(t), part.stamp, part.id, part.length, part.data, part.flags))
        together = concatenate_frames(frames)
        out: list[list[Raw]] = [[together[np.argsort(together.arrival, kind="stable")]]]
        for device in self._serial:
            t, pieces = device.encode(block)
            out.append([SerialChunk(a, data) for a, data in zip(self._arrival(t).tolist(), pieces, strict=True)])
        return out

    def _arrival(self, t: Array) -> Array:
        return np.maximum.accumulate(t + 0.004 + self._random.uniform(0.0, 2e-3, t.size))


def by_tick(items: list[Raw], first: int, count: int) -> list[list[Raw]]:
    """Items that arrived within each of `count` ticks from `first` on, those before it in the first one."""
    out: list[list[Raw]] = [[] for _ in range(count)]
    for item in items:
        if isinstance(item, CanFrames):
            edges = np.searchsorted(item.arrival, [tick_time(first + k) for k in range(1, count)])
            for k, (a, b) in enumerate(pairwise([0, *edges.tolist(), len(item)])):
                out[k] += [item[a:b]] if b > a else []
        else:
            out[min(max(int(item.arrival / TICK) - first, 0), count - 1)].append(item)
    return out


def test_hours_at_full_speed(tmp_path: Path) -> None:
    """Memory and π over hours of simulated time; HOURS in the environment, 1 by default, 24 for the whole day."""
    file, system = bench_system(tmp_path)
    blocks = list(MovingArm(system, 20.0, "0", 1))
    sensors = Sensors(system, Plant(system).channels, None, 1)
    columns = [blocks[0].channels.index(channel) for channel in sensors.channels]
    motion = np.concatenate([block.values for block in blocks])[:-1, columns]
    bus = Devices(system, file.parent)
    ours = merger(system, file.parent)
    estimator = Estimator(system, ours.channels, "bench")
    # Each motion begins anew, from rest, after a pause of the serial devices, which ends a segment.
    pause = np.repeat(motion[-1:], round(PERIOD * system.sample_rate) - motion.shape[0], axis=0)
    on_can = {channel for group in messages(sensors.channels) for channel in group}
    pause[:, [channel not in on_can for channel in sensors.channels]] = np.nan
    motion = np.concatenate((motion, pause))
    rounds = round(float(os.environ.get("HOURS", "1")) * 3600.0 / PERIOD)
    ticks = round(PERIOD / TICK)
    began = perf_counter()
    for k in range(rounds):
        rows = np.arange(motion.shape[0])
        values = sensors.read(k * motion.shape[0], motion)
        sources = bus.items(Block(k * PERIOD + rows / system.sample_rate, sensors.channels, values))
        parts = [by_tick(items, k * ticks, ticks) for items in sources]
        for tick in range(ticks):
            block = ours.advance(tick_time(k * ticks + tick + 1), [part[tick] for part in parts])
            if block is not None:
                estimator.push(block)
        if k % max(1, rounds // 12) == 0 or k == rounds - 1:
            hours = (k + 1) * PERIOD / 3600.0
            pi, std = estimator.estimate().pi, standard_deviation(estimator)
            shown = ", ".join(f"{estimator.base.parameters[j].name} {pi[j]:.6g} ± {std[j]:.2g}" for j in (8, 10, 12))
            took = perf_counter() - began
            print(f"\n{hours:6.2f} h in {took:6.0f} s, resident {resident():.1f} MB, {shown}", end="", flush=True)
    print()
    print("\n".join(ours.warnings))


# Samples of a period of the axis: its message counts to 65536, so that frames repeat with it, arrivals apart.
ROUND = 1 << 16
AXIS_DBC = """VERSION ""
NS_ :
BS_:
BU_: ARM

BO_ 256 AXIS: 8 ARM
 SG_ FORCE : 0|24@1- (1E-05,0) [0|0] "" Vector__XXX
 SG_ ANGLE : 24|24@1- (1E-06,0) [0|0] "" Vector__XXX
 SG_ COUNT : 48|16@1+ (1,0) [0|0] "" Vector__XXX
"""
AXIS_SOURCE = """
[[source]]
kind = "can"
name = "bus"
dbc = "axis.dbc"
interface = "virtual"
signals = { "AXIS.FORCE" = "force_1", "AXIS.ANGLE" = "q_1" }
counters = ["AXIS.COUNT"]
"""
# Ticks processed at once, so that a day takes minutes: still less than what a session waits for a source.
TICKS = 10


def axis_round(random: np.random.Generator) -> CanFrames:
    """What an axis sends in a period of its motion, 65.536 s, with noise, drift of its clock and delays."""
    w = 2.0 * np.pi * np.array([21.0, 52.0]) / ROUND * 1000.0  # rad/s, some 2 and 5
    phase = np.arange(ROUND)[:, None] / 1000.0 * w
    q = np.sin(phase) @ [1.0, 0.3]
    torque = np.cos(phase) @ (DAMPING * w * [1.0, 0.3]) - np.sin(phase) @ (INERTIA * w**2 * [1.0, 0.3])
    word = np.arange(ROUND, dtype=np.uint64) << np.uint64(48)
    for values, noise, step, start in ((torque, 0.01, 1e-5, 0), (q, 1e-4, 1e-6, 24)):
        counts = np.rint((values + noise * random.standard_normal(ROUND)) / step).astype(np.int64) & 0xFFFFFF
        word |= counts.astype(np.uint64) << np.uint64(start)
    data = np.zeros((ROUND, 64), dtype=np.uint8)
    data[:, :8] = word.astype("<u8").view(np.uint8).reshape(ROUND, 8)
    t = np.arange(ROUND) * 1e-3 * (1.0 + 5e-5)
    arrival = np.maximum.accumulate(t + random.uniform(0.0, 2e-3, ROUND))
    plain = np.zeros(ROUND, dtype=np.uint8)
    id_ = np.full(ROUND, 256, np.uint32)
    return CanFrames(arrival, np.full(ROUND, np.nan), id_, plain + np.uint8(8), data, plain)


@pytest.mark.parametrize("balance", ["energy", "both"])
def test_a_day_at_full_speed(tmp_path: Path, balance: str) -> None:
    """Memory and π over a day of one axis at 1 kHz, with history and checkpoints; HOURS as above, 24 by default."""
    (tmp_path / "axis.dbc").write_text(AXIS_DBC)
    described = f'balance = "{balance}"\n' + AXIS.replace("sample_rate = 200.0", "sample_rate = 1000.0")
    (tmp_path / "axis.toml").write_text(described + AXIS_SOURCE)
    system = load_system(str(tmp_path / "axis.toml"))
    frames = axis_round(np.random.default_rng(1))
    ours = merger(system, tmp_path)
    session = Session(system, ours.channels)
    estimator, course = session.estimator, CourseRecorder(session)
    rounds = round(float(os.environ.get("HOURS", "24")) * 3600.0 / (ROUND * 1e-3))

    def blocks() -> Iterator[Block]:
        tick = 0
        for k in range(rounds):
            arrival = frames.arrival + k * ROUND * 1e-3 * (1.0 + 5e-5)
            now = replace(frames, arrival=arrival)
            steps = np.arange(tick, int(arrival[-1] / TICK), TICKS)[1:]
            edges = np.searchsorted(arrival, [tick_time(int(step)) for step in steps])
            for step, a, b in zip(steps.tolist(), [0, *edges[:-1].tolist()], edges.tolist(), strict=True):
                block = ours.advance(tick_time(step), [[now[a:b]] if b > a else []])
                if block is not None:
                    yield block
            tick = int(steps[-1])
            block = ours.advance(tick_time(tick), [[now[int(edges[-1]) :]]])
            if block is not None:
                yield block
            write_checkpoint(tmp_path / "checkpoint.msgpack", Checkpoint.of(estimator))
            if k % max(1, rounds // 24) == 0 or k == rounds - 1:
                hours, pi, std = (k + 1) * ROUND / 3.6e6, estimator.estimate().pi, standard_deviation(estimator)
                shown = ", ".join(f"{p:.6f} ± {2 * s:.6f}" for p, s in zip(pi, std, strict=True))
                took = perf_counter() - began
                print(f"\n{hours:6.2f} h in {took:6.0f} s, resident {resident():.1f} MB, {shown}", end="", flush=True)

    began = perf_counter()
    for block in course.watch(blocks()):
        session.update(block)
    print()
    print("\n".join(ours.warnings), f"events {len(estimator.events)}, lost {estimator.counters.lost_samples}")


def resident() -> float:
    """Memory of this process now, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6
