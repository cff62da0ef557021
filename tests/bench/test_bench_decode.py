"""Frames a second of the decoders: whole CAN logs, serial frames and lines; and what a python-can reader costs live."""

from __future__ import annotations

import os
import time
from pathlib import Path

import can
import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from sms_adapters.can_reader import CanReader, open_bus
from sms_adapters.can_replay import open_log
from sms_adapters.devices import make_can_decoder, make_decoder
from sms_adapters.raw import CanFrames, SerialChunk
from sms_adapters.serial_decoder import encode_frames, frame_layout
from sms_online.description.sources import CanBus, CanSource, FrameField, SerialField, SerialFrames, SerialLines

COUNT = 200_000
# Four encoders and the torques, as on a testbed's bus.
SIGNALS = {f"NODE_{k}.{name}": f"{name}_{k}" for k in range(5) for name in ("A", "B")}
DBC = 'VERSION ""\n\nBS_:\n\nBU_: R\n\n' + "".join(
    f'BO_ {256 + k} NODE_{k}: 8 R\n SG_ A : 0|24@1- (1E-06,0) [0|0] "" R\n SG_ B : 31|32@0- (1E-06,0) [0|0] "" R\n\n'
    for k in range(5)
)


@pytest.fixture
def source(tmp_path: Path) -> CanSource:
    (tmp_path / "bench.dbc").write_text(DBC)
    return CanSource.model_validate({"kind": "can", "name": "bus", "dbc": "bench.dbc", "signals": SIGNALS})


def random_frames() -> CanFrames:
    rng = np.random.default_rng(1)
    data = np.zeros((COUNT, 64), dtype=np.uint8)
    data[:, :8] = rng.integers(0, 256, (COUNT, 8))
    t = np.arange(COUNT) / 5000
    ids = (256 + np.arange(COUNT) % 5).astype(np.uint32)
    return CanFrames(t, t, ids, np.full(COUNT, 8, np.uint8), data, np.zeros(COUNT, np.uint8))


def rate(benchmark: BenchmarkFixture, count: int) -> None:
    assert benchmark.stats is not None
    benchmark.extra_info["per_second"] = round(count / benchmark.stats.stats.median)


def test_can_frames_decode(benchmark: BenchmarkFixture, source: CanSource, tmp_path: Path) -> None:
    frames = random_frames()
    benchmark(lambda: make_can_decoder(source, tmp_path).push(frames))
    rate(benchmark, COUNT)


def test_a_candump_log_parses_and_decodes(benchmark: BenchmarkFixture, source: CanSource, tmp_path: Path) -> None:
    frames = random_frames()
    path = tmp_path / "run.log"
    rows = zip(frames.arrival.tolist(), frames.id.tolist(), frames.data[:, :8], strict=True)
    path.write_text("".join(f"({1600000000 + t:.6f}) can0 {id_:03X}#{bytes(data).hex()}\n" for t, id_, data in rows))

    def read() -> int:
        decoder = make_can_decoder(source, tmp_path)
        return sum(decoder.push(logged.frames).t_arrival.size for logged in open_log(path))

    assert benchmark(read) == COUNT
    rate(benchmark, COUNT)


def test_serial_frames_decode(benchmark: BenchmarkFixture) -> None:
    fields = (
        FrameField(type="u16", counter=True),
        FrameField(type="u32", tick=1e-6),
        *(FrameField(type="i32", channel=f"c{k}", scale=1e-6) for k in range(6)),
    )
    words = np.zeros(COUNT, frame_layout(fields))
    words["f0"], words["f1"] = np.arange(COUNT) % 65536, np.arange(COUNT) * 100
    stream = b"".join(encode_frames(words))
    decode_serial(benchmark, SerialFrames(kind="serial", name="s", port="x", format="frames", fields=fields), stream)


def test_serial_lines_decode(benchmark: BenchmarkFixture) -> None:
    described = SerialLines(
        kind="serial", name="s", port="x", format="lines", fields=tuple(SerialField(channel=c) for c in "abc")
    )
    numbers = np.random.default_rng(2).random((COUNT, 3)).round(6).tolist()
    stream = "".join(f"{a},{b},{c}\n" for a, b, c in numbers).encode()
    decode_serial(benchmark, described, stream)


def decode_serial(benchmark: BenchmarkFixture, described: SerialFrames | SerialLines, stream: bytes) -> None:
    """Bench a stream that comes in chunks of 4 kB."""
    chunks = [SerialChunk(float(k), stream[k : k + 4096]) for k in range(0, len(stream), 4096)]

    def decode() -> int:
        decoder = make_decoder(described, None)
        return sum(decoder.push(chunk).t_arrival.size for chunk in chunks)

    assert benchmark(decode) == COUNT
    rate(benchmark, COUNT)


@pytest.mark.parametrize(
    "bus",
    [
        {"interface": "virtual", "channel": "bench"},
        {"interface": "udp_multicast", "channel": "239.74.163.2", "options": {"port": 20_000 + os.getpid() % 20_000}},
    ],
    ids=["virtual", "udp_multicast"],
)
def test_a_live_reader(benchmark: BenchmarkFixture, bus: dict[str, object]) -> None:
    """Ten frames a read, as 10 kHz and a read a millisecond give."""
    described = CanBus.model_validate({"name": "bus"} | bus)
    reader, node = CanReader(described, time.monotonic), open_bus(described)
    reader.open()
    message = can.Message(arbitration_id=256, is_extended_id=False, data=bytes(8))

    def send() -> None:
        for _ in range(10):
            node.send(message)
        time.sleep(2e-3)

    try:
        benchmark.pedantic(lambda: reader.read(1.0), setup=send, rounds=500)  # type: ignore[no-untyped-call]
    finally:
        reader.close()
        node.shutdown()
    rate(benchmark, 10)
