"""Devices that misbehave, alone and all together: each fault is counted, and π stays within its own error bars."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_adapters.can_reader import BUS_OFF
from sms_adapters.raw import ERROR_FRAME, CanFrames, SerialChunk, concatenate_frames
from sms_online.description.schema import System
from tests.axis import DAMPING, INERTIA
from tests.bus_streams import LINES, SOURCES, AxisBus, axis_testbed, estimated, in_order, merged

SECONDS = 20.0


@dataclass
class Session:
    """A bus to be spoilt, and its raw items once its devices have sent."""

    bus: AxisBus
    system: System
    random: np.random.Generator
    drive: CanFrames
    encoder: list[SerialChunk]


def keep(session: Session, drive: NDArray[np.bool_], encoder: NDArray[np.bool_]) -> None:
    session.drive = session.drive[drive]
    first, *chunks = session.encoder
    session.encoder = [first, *(chunk for chunk, kept in zip(chunks, encoder.tolist(), strict=True) if kept)]


def arrivals(session: Session) -> NDArray[np.float64]:
    return np.array([chunk.arrival for chunk in session.encoder[1:]])


def frames_lost(s: Session) -> None:
    keep(s, s.random.uniform(size=len(s.drive)) > 0.1, s.random.uniform(size=len(s.encoder) - 1) > 0.1)


def bursts_lost(s: Session) -> None:
    # A second of the drive, and another of the encoder.
    a, t = s.drive.arrival, arrivals(s)
    keep(s, (a < 6.0) | (a > 7.0), (t < 11.0) | (t > 12.0))


def duplicates(s: Session) -> None:
    rows = np.sort(np.concatenate((np.arange(len(s.drive)), s.random.integers(0, len(s.drive), 100))))
    s.drive = s.drive[rows]
    s.encoder = [chunk for chunk in s.encoder for _ in range(1 + int(s.random.uniform() < 0.05))]


def reordering(s: Session) -> None:
    # Some frames come after the one that was sent after them.
    arrival = s.drive.arrival.copy()
    late = s.random.choice(np.arange(200, arrival.size - 2, 5), 100, replace=False)
    arrival[late] = arrival[late + 1] + 1e-6
    order = np.argsort(arrival, kind="stable")
    s.drive = CanFrames(arrival, *(getattr(s.drive, n) for n in ("stamp", "id", "length", "data", "flags")))[order]


def corrupt_payload(s: Session) -> None:
    s.encoder = [spoilt(s, chunk) if s.random.uniform() < 0.05 else chunk for chunk in s.encoder]


def spoilt(s: Session, chunk: SerialChunk) -> SerialChunk:
    data = bytearray(chunk.data)
    data[int(s.random.integers(0, max(len(data) - 1, 1)))] ^= int(s.random.integers(1, 256))
    return SerialChunk(chunk.arrival, bytes(data))


def corrupt_words(s: Session) -> None:
    # A sender that now and then fills a frame with anything, its counter included.
    data = s.drive.data.copy()
    rows = np.flatnonzero(s.random.uniform(size=len(s.drive)) < 0.005)
    data[rows, :8] = s.random.integers(0, 256, (rows.size, 8))
    s.drive = replace(s.drive, data=data)


def wrong_length(s: Session) -> None:
    s.drive.length[s.random.integers(0, len(s.drive), 100)] = 5


def unknown_ids(s: Session) -> None:
    strangers = s.drive[s.random.integers(0, len(s.drive), 200)]
    strangers.id[:] = 0x7FF
    both = concatenate_frames([s.drive, strangers])
    s.drive = both[np.argsort(both.arrival, kind="stable")]


def error_frames(s: Session) -> None:
    noise = s.drive[np.arange(0, len(s.drive), 50)]
    noise.flags[:] = ERROR_FRAME
    both = concatenate_frames([s.drive, noise])
    s.drive = both[np.argsort(both.arrival, kind="stable")]


def bus_off(s: Session) -> None:
    # The controller gives up, and is started again a second later.
    last = s.drive[s.drive.arrival < 9.0][-1:]
    said = replace(last, id=np.array([BUS_OFF], dtype=np.uint32), flags=np.array([ERROR_FRAME], dtype=np.uint8))
    s.drive = concatenate_frames([s.drive[s.drive.arrival < 9.0], said, s.drive[s.drive.arrival > 10.2]])


def unplugged(s: Session) -> None:
    # Out for three seconds, in the middle of a frame; the port then begins with a break.
    t = arrivals(s)
    keep(s, np.ones(len(s.drive), dtype=bool), (t < 8.0) | (t > 11.0))
    k = 1 + int(np.searchsorted(arrivals(s), 8.0))
    half = SerialChunk(s.encoder[k - 1].arrival, s.encoder[k - 1].data[:9])
    s.encoder[k - 1 : k] = [half, SerialChunk(s.encoder[k].arrival, b"")]


def half_frames(s: Session) -> None:
    s.encoder = [
        SerialChunk(chunk.arrival, chunk.data[:7]) if 100 < k < 2000 and k % 40 == 0 else chunk
        for k, chunk in enumerate(s.encoder)
    ]


def not_text(s: Session) -> None:
    lines = [SerialChunk(chunk.arrival, b"\xff\xfe" + chunk.data) for chunk in s.encoder[1:]]
    s.encoder[1:] = [
        line if k % 50 == 7 else chunk for k, (line, chunk) in enumerate(zip(lines, s.encoder[1:], strict=True))
    ]


def not_a_number(s: Session) -> None:
    s.bus.angle[s.random.integers(200, s.bus.angle.size, 50)] = np.nan
    s.encoder = s.bus.encoder(s.system)


def stuck_sensor(s: Session) -> None:
    s.bus.angle[1400:1900] = s.bus.angle[1400]
    s.encoder = s.bus.encoder(s.system)


def torque_saturates(s: Session) -> None:
    limit = 0.8 * np.abs(s.bus.torque).max()
    s.bus.torque = np.clip(s.bus.torque, -limit, limit)
    s.drive = s.bus.drive()


def clock_jump(s: Session) -> None:
    s.bus.ticks[2000:] += 2.0
    s.encoder = s.bus.encoder(s.system)


def device_restarts(s: Session) -> None:
    # Its clock begins again at zero, after half a second of silence.
    s.bus.ticks[2100:] -= s.bus.ticks[2100]
    s.encoder = s.bus.encoder(s.system)
    keep(
        s,
        np.ones(len(s.drive), dtype=bool),
        (np.arange(s.bus.angle.size) < 2000) | (np.arange(s.bus.angle.size) >= 2100),
    )


def transport_stalls(s: Session) -> None:
    # A tenth of a second in which nothing arrives, then all of it at once.
    a = s.drive.arrival
    stalled = in_order(np.where((a > 9.0) & (a < 9.1), 9.1, a))
    s.drive = CanFrames(stalled, *(getattr(s.drive, n) for n in ("stamp", "id", "length", "data", "flags")))


FAULTS: dict[Callable[[Session], None], str] = {
    frames_lost: "drive: 39. frames lost, their counts are missing",
    bursts_lost: "drive: 200 frames lost, their counts are missing",
    duplicates: "drive: .* frames skipped, their time repeats that of their message's last one",
    reordering: "drive: 100 frames skipped, their counter goes back",
    corrupt_payload: "encoder: .* frames skipped, their checksum is wrong",
    wrong_length: "drive: .* frames skipped, their length is not the described one",
    unknown_ids: "drive: 200 frames skipped, no channel comes from their ids",
    error_frames: "drive: 80 error frames, the bus or its controller reports trouble",
    unplugged: "encoder: silent for more than 1 s, 1 times",
    half_frames: "encoder: 47 stretches skipped, longer than any frame or line that is described",
    not_a_number: "encoder: .* values skipped, NaN or infinite",
    stuck_sensor: "q_1: 49. samples skipped, the sensor stood still or at its limit",
    torque_saturates: "force_1: .* samples skipped, the sensor stood still or at its limit",
    clock_jump: r"encoder: 1 jumps of its clock, the last by \+2.000 s",
    device_restarts: "encoder: 1 jumps of its clock, the last by",
    transport_stalls: "",
    corrupt_words: "drive: 5 values skipped, outside the limits of their channel",
    bus_off: "drive: 1 error frames, the bus or its controller reports trouble",
}
# Of an encoder that prints lines.
LINE_FAULTS: dict[Callable[[Session], None], str] = {
    not_text: "encoder: 80 lines skipped, they are not text",
    half_frames: "encoder: 47 frames skipped, their checksum is wrong",
    corrupt_payload: "encoder: .* frames skipped, their checksum is wrong",
}


# First what changes the measured values, then what happens to the frames.
TOGETHER = (
    torque_saturates, stuck_sensor, clock_jump, not_a_number, transport_stalls, unplugged, bursts_lost, bus_off,
    frames_lost, reordering, duplicates, corrupt_words, corrupt_payload, wrong_length, unknown_ids, error_frames,
)  # fmt: skip


def session(folder: Path, sources: str = SOURCES) -> Session:
    system = axis_testbed(folder, sources)
    bus = AxisBus(seconds=SECONDS, drift=(2e-5, -3e-5), offset=0.3)
    return Session(bus, system, np.random.default_rng(11), bus.drive(), bus.encoder(system))


def outcome(s: Session, folder: Path) -> tuple[list[str], NDArray[np.float64], NDArray[np.float64]]:
    """Warnings, error of π in its own standard deviations, and these."""
    merger, blocks = merged(s.system, folder, s.drive, s.encoder)
    pi, std = estimated(s.system, blocks, merger.channels)
    return merger.warnings, (pi - [INERTIA, DAMPING]) / std, std


def check(s: Session, folder: Path, expected: str) -> None:
    """The fault is named, and π stays within its error bars."""
    warnings, errors, std = outcome(s, folder)
    if expected:
        assert any(re.match(expected, warning) for warning in warnings), warnings
    else:
        assert warnings == []
    assert (np.abs(errors) < 4.0).all(), (errors, std)
    assert (std < [0.01, 0.01]).all()


@pytest.mark.long
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_each_fault_alone(tmp_path: Path, fault: Callable[[Session], None]) -> None:
    s = session(tmp_path)
    fault(s)
    check(s, tmp_path, FAULTS[fault])


@pytest.mark.long
@pytest.mark.parametrize("fault", LINE_FAULTS, ids=lambda fault: fault.__name__)
def test_each_fault_of_an_encoder_that_prints_lines(tmp_path: Path, fault: Callable[[Session], None]) -> None:
    s = session(tmp_path, LINES)
    fault(s)
    check(s, tmp_path, LINE_FAULTS[fault])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sources", "further"), [(SOURCES, (half_frames,)), (LINES, (not_text, half_frames))], ids=["frames", "lines"]
)
def test_all_faults_together(tmp_path: Path, sources: str, further: tuple[Callable[[Session], None], ...]) -> None:
    s = session(tmp_path, sources)
    for fault in (*TOGETHER, *further):
        fault(s)
    warnings, errors, std = outcome(s, tmp_path)
    assert len(warnings) >= 12
    assert (np.abs(errors) < 4.0).all(), (errors, std)
    assert (std < [0.01, 0.01]).all()
