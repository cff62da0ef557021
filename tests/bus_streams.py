"""A testbed of one axis whose raw items are made up: torque on CAN, encoder on serial, each on its own clock."""

from __future__ import annotations

import functools
import itertools
import operator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sms_adapters.clock_lanes import merger
from sms_adapters.clock_merge import Merger
from sms_adapters.raw import MOST_BYTES, CanFrames, Raw, SerialChunk
from sms_adapters.recording import split, tick_time
from sms_adapters.serial_decoder import encode_frames, frame_layout
from sms_adapters.system_file import load_system
from sms_online.description.schema import System
from sms_online.description.sources import SerialFrames
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array, Block
from tests.axis import AXIS, DAMPING, INERTIA
from tests.evaluated import standard_deviation

RATE = 200.0  # Hz
TORQUE_NOISE, ANGLE_NOISE = 0.01, 1e-4  # N m, rad: a fair torque sensor, a good encoder
TORQUE_STEP = 1e-5  # N m a count on CAN
DRIVE_ID = 0x101
DBC = f"""VERSION ""
NS_ :
BS_:
BU_: ARM

BO_ {DRIVE_ID} DRIVE: 8 ARM
 SG_ TORQUE : 0|24@1- ({TORQUE_STEP},0) [0|0] "" Vector__XXX
 SG_ COUNT : 48|16@1+ (1,0) [0|0] "" Vector__XXX
"""
SOURCES = """
[[source]]
kind = "can"
name = "drive"
dbc = "axis.dbc"
interface = "virtual"
signals = { "DRIVE.TORQUE" = { channel = "force_1", minimum = -6.0, maximum = 6.0 } }
counters = ["DRIVE.COUNT"]
latency = 0.003

[[source]]
kind = "serial"
name = "encoder"
port = "/dev/null"
format = "frames"
latency = 0.005
fields = [{ type = "u32", tick = 1e-6 }, { type = "f64", channel = "q_1" }]
"""
# The same encoder, printing its numbers.
LINES = SOURCES.replace("frames", "lines").replace('type = "u32", tick = 1e-6', "tick = 1e-6, wrap = 4294967296")
LINES = LINES.replace('type = "f64", ', "") + 'checksum = "xor"\n'
LATENCY = {"drive": 0.003, "encoder": 0.005}


def axis_testbed(folder: Path, text: str = SOURCES) -> System:
    """The description, with its files in `folder`."""
    (folder / "axis.dbc").write_text(DBC)
    (folder / "axis.toml").write_text(AXIS + text)
    return load_system(str(folder / "axis.toml"))


def motion(t: Array) -> tuple[Array, Array]:
    """Torque (N m) and angle (rad) at instants t (s), by inverse dynamics."""
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    rate, acceleration = 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t), -4 * np.sin(2 * t) - 7.5 * np.sin(5 * t)
    return INERTIA * acceleration + DAMPING * rate, q


@dataclass
class AxisBus:
    """What the devices send over `seconds`, to be spoilt before it is used.

    drift, offset: of the drive's and the encoder's clock against the session's. jitter: uniform delay, s.
    torque, angle: (n,) as measured. ticks: (n,) s, what the encoder's clock showed.
    """

    seconds: float = 20.0
    seed: int = 1
    drift: tuple[float, float] = (0.0, 0.0)
    offset: float = 0.0
    jitter: float = 0.002
    torque: Array = field(init=False)
    angle: Array = field(init=False)
    ticks: Array = field(init=False)
    drive_arrival: Array = field(init=False)
    encoder_arrival: Array = field(init=False)

    def __post_init__(self) -> None:
        random = np.random.default_rng(self.seed)
        n = round(self.seconds * RATE)
        # Each device samples periodically on its own clock.
        drive_t = 0.5 + np.arange(n) / RATE * (1.0 + self.drift[0])
        encoder_t = 0.5 + np.arange(n) / RATE * (1.0 + self.drift[1])
        self.torque = motion(drive_t)[0] + TORQUE_NOISE * random.standard_normal(n)
        self.angle = motion(encoder_t)[1] + ANGLE_NOISE * random.standard_normal(n)
        self.ticks = (encoder_t - 0.5) / (1.0 + self.drift[1]) + self.offset
        delays = random.uniform(0.0, self.jitter, (2, n))
        self.drive_arrival = in_order(drive_t + LATENCY["drive"] + delays[0])
        self.encoder_arrival = in_order(encoder_t + LATENCY["encoder"] + delays[1])

    def drive(self) -> CanFrames:
        """The drive's frames."""
        n = self.torque.size
        words = np.zeros(n, dtype=[("torque", "<u4"), ("unused", "<u2"), ("count", "<u2")])
        words["torque"] = np.rint(self.torque / TORQUE_STEP).astype(np.int64) & 0xFFFFFF
        words["count"] = np.arange(n) % (1 << 16)
        data = np.zeros((n, MOST_BYTES), dtype=np.uint8)
        data[:, :8] = words.view(np.uint8).reshape(n, 8)
        plain = np.zeros(n, dtype=np.uint8)
        id_ = np.full(n, DRIVE_ID, dtype=np.uint32)
        return CanFrames(self.drive_arrival, np.full(n, np.nan), id_, plain + np.uint8(8), data, plain)

    def encoder(self, system: System) -> list[SerialChunk]:
        """The encoder's frames, or lines, a chunk each."""
        source = system.sources[1]
        ticks = np.mod(np.rint(self.ticks * 1e6), 2.0**32)
        if isinstance(source, SerialFrames):
            words = np.zeros(self.angle.size, dtype=frame_layout(source.fields))
            words["f0"], words["f1"] = ticks, self.angle
            sent, end = encode_frames(words), b"\0"
        else:
            rows = zip(ticks.astype(np.int64).tolist(), self.angle.tolist(), strict=True)
            sent, end = [checked(f"{tick},{angle!r}".encode()) for tick, angle in rows], b"\n"
        chunks = [SerialChunk(t, data) for t, data in zip(self.encoder_arrival.tolist(), sent, strict=True)]
        return [SerialChunk(0.0, end), *chunks]  # an end, so that the first frame is known to be whole


def checked(text: bytes) -> bytes:
    """A line with its checksum."""
    return b"%s*%02X\n" % (text, functools.reduce(operator.xor, text))


def in_order(arrival: Array) -> Array:
    """Arrivals of a transport that keeps the order, in whole microseconds."""
    return np.maximum.accumulate(np.rint(arrival * 1e6) * 1e-6)


def ticks(drive: CanFrames, encoder: list[SerialChunk]) -> list[tuple[list[Raw], list[Raw]]]:
    """What arrives before each tick of a session, from the first one on."""
    by_tick: dict[int, tuple[list[Raw], list[Raw]]] = {}
    number = 1
    rest: list[Raw] = [drive] if len(drive) else []
    while rest:
        early, rest = split(rest, tick_time(number))
        by_tick[number] = (early, [])
        number += 1
    for chunk in encoder:
        number = next(k for k in itertools.count(int(chunk.arrival / tick_time(1))) if chunk.arrival < tick_time(k))
        by_tick.setdefault(number, ([], []))[1].append(chunk)
    return [by_tick.get(k, ([], [])) for k in range(1, max(by_tick) + 1)]


def merged(system: System, folder: Path, drive: CanFrames, encoder: list[SerialChunk]) -> tuple[Merger, list[Block]]:
    """The rows of a session with these raw items."""
    ours = merger(system, folder)
    blocks = [ours.advance(tick_time(k), items) for k, items in enumerate(ticks(drive, encoder), start=1)]
    return ours, [block for block in [*blocks, ours.finish()] if block is not None]


def estimated(system: System, blocks: list[Block], channels: tuple[str, ...]) -> tuple[Array, Array]:
    """π and its standard deviations (2,): inertia, damping."""
    estimator = Estimator(system, channels, "made up")
    for block in blocks:
        estimator.push(block)
    estimator.finish()
    return estimator.estimate().pi, standard_deviation(estimator)
