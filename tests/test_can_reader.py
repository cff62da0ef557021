"""A CAN bus read live: all its frames, their stamps, and what happens when it fails."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest
from numpy.typing import NDArray

from sms_adapters.can_reader import MOST_FRAMES, MOST_GARBLED, CanReader, open_bus
from sms_adapters.can_replay import open_log
from sms_adapters.devices import make_decoder, make_reader
from sms_adapters.raw import (
    ERROR_FRAME,
    EXTENDED,
    FD_FRAME,
    REMOTE_FRAME,
    CanFrames,
    LostDevice,
    Reader,
    concatenate_frames,
)
from sms_online.description.sources import CanBus, CanSource
from sms_online.errors import InputError

DATA = Path(__file__).parents[2] / "shared" / "data" / "ak80_pendulum"
CHANNELS = itertools.count()
# A port of this process: everybody who joins it hears what is sent there.
UDP = {"interface": "udp_multicast", "channel": "239.74.163.2", "options": {"port": 20_000 + os.getpid() % 20_000}}


@pytest.fixture
def bus() -> Iterator[tuple[CanReader, can.BusABC]]:
    """An open reader on a virtual bus, and another node of that bus."""
    source = CanBus(name="bus", interface="virtual", channel=f"reader-{next(CHANNELS)}")
    reader = CanReader(source, time.monotonic)
    reader.open()
    node = open_bus(source)
    yield reader, node
    reader.close()
    node.shutdown()


def received(reader: Reader, count: int, patience: float = 5.0) -> CanFrames:
    """That many frames; fails where they do not come."""
    parts: list[CanFrames] = []
    end = time.monotonic() + patience
    while sum(len(part) for part in parts) < count:
        assert time.monotonic() < end, f"{sum(len(part) for part in parts)} of {count} frames"
        parts += [raw for raw in reader.read(0.1) if isinstance(raw, CanFrames)]
    return concatenate_frames(parts)


def test_frames_come_as_they_were_sent(bus: tuple[CanReader, can.BusABC]) -> None:
    reader, node = bus
    before = time.monotonic()
    node.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x01\x02"))
    node.send(can.Message(arbitration_id=0x123, is_extended_id=True, data=bytes(range(8))))
    node.send(can.Message(arbitration_id=0x7, is_extended_id=False, is_remote_frame=True, dlc=5))
    node.send(can.Message(arbitration_id=0x8, is_extended_id=False, is_fd=True, data=bytes(range(64))))
    node.send(can.Message(is_error_frame=True, arbitration_id=0x4, is_extended_id=False))
    frames = received(reader, 5)
    assert frames.id.tolist() == [0x123, 0x123 | EXTENDED, 0x7, 0x8, 0x4]
    assert frames.length.tolist() == [2, 8, 5, 64, 0]
    assert frames.flags.tolist() == [0, 0, REMOTE_FRAME, FD_FRAME, ERROR_FRAME]
    assert frames.data[0].tolist() == [1, 2, *[0] * 62]
    assert frames.data[3].tolist() == list(range(64))
    assert (np.diff(frames.arrival) >= 0).all()
    assert before <= frames.arrival[0] <= frames.arrival[-1] <= time.monotonic()
    assert (np.diff(frames.stamp) >= 0).all()  # python-can's, of the host
    assert abs(frames.stamp[0] - time.time()) < 60.0


@pytest.mark.realtime
def test_a_frame_that_waited_arrived_when_it_was_stamped(bus: tuple[CanReader, can.BusABC]) -> None:
    reader, node = bus
    sent = time.monotonic()
    node.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x01"))
    time.sleep(0.3)
    frames = received(reader, 1)
    assert time.monotonic() - sent > 0.3
    assert frames.arrival[0] - sent < 0.2


@pytest.mark.realtime
def test_an_interrupted_reader_makes_no_frame_early(
    bus: tuple[CanReader, can.BusABC], monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, node = bus
    sent = time.monotonic()
    node.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x01"))
    utc, stalls = time.time, iter([0.01] * 4)

    def interrupted() -> float:
        time.sleep(next(stalls, 0.0))
        return utc()

    monkeypatch.setattr(time, "time", interrupted)
    frames = received(reader, 1)
    assert next(stalls, None) is None
    assert sent - 1e-4 < frames.arrival[0] < sent + 5e-3


def test_a_flooded_bus_gives_bounded_pieces(bus: tuple[CanReader, can.BusABC]) -> None:
    reader, node = bus
    assert reader.read(0.01) == []
    for k in range(MOST_FRAMES + 100):
        node.send(can.Message(arbitration_id=k & 0x7FF, is_extended_id=False))
    (first,) = reader.read(0.1)
    assert isinstance(first, CanFrames)
    assert len(first) == MOST_FRAMES
    rest = received(reader, 100)
    assert np.array_equal(concatenate_frames([first, rest]).id, np.arange(MOST_FRAMES + 100) & 0x7FF)


@pytest.mark.realtime
def test_frames_are_stamped_by_the_kernel_over_udp() -> None:
    source = CanBus(name="bus", **UDP)
    reader = CanReader(source, time.monotonic)
    reader.open()
    node = open_bus(source)
    time.sleep(0.1)  # of the first socket that asks for stamps, the kernel heeds it a little later
    try:
        for k in range(200):
            node.send(can.Message(arbitration_id=k, is_extended_id=False, data=bytes([k])))
        time.sleep(0.2)  # they wait in the socket; the kernel stamped them as they came
        read_from = time.time()
        frames = received(reader, 200)
    finally:
        reader.close()
        node.shutdown()
    assert frames.id.tolist() == list(range(200))
    assert (frames.stamp < read_from - 0.1).all()
    assert (np.diff(frames.stamp) >= 0).all()


def test_after_bus_off_a_bus_can_be_opened_again(bus: tuple[CanReader, can.BusABC]) -> None:
    reader, node = bus
    node.send(can.Message(arbitration_id=7, is_extended_id=False))
    node.send(can.Message(is_error_frame=True, arbitration_id=0x40, is_extended_id=False))
    assert received(reader, 2).flags.tolist() == [0, ERROR_FRAME]  # what came before is not lost with it
    with pytest.raises(LostDevice, match="bus: bus-off"):
        reader.read(0.1)
    reader.open()
    node.send(can.Message(arbitration_id=1, is_extended_id=False))
    assert received(reader, 1).id.tolist() == [1]
    reader._bus.shutdown()  # type: ignore[union-attr]  # as an adapter that is pulled out
    with pytest.raises(LostDevice, match="bus: "):
        reader.read(0.1)
    reader.close()
    reader.close()
    with pytest.raises(LostDevice, match="not open"):
        reader.read(0.0)


def test_a_bus_that_cannot_be_opened_is_lost() -> None:
    source = CanSource(kind="can", name="arm", interface="slcan", channel="/dev/absent", dbc="a.dbc", signals={})
    reader = make_reader(source, time.monotonic)
    with pytest.raises(LostDevice, match=r"^arm: ") as lost:
        reader.open()
    assert "slcan /dev/absent" in lost.value.why
    assert "\n" not in str(lost.value)


@pytest.mark.parametrize("interface", ["nonesuch", "nican", "vector"])
def test_a_bus_that_can_never_be_opened_is_bad_input(interface: str) -> None:
    source = CanSource(kind="can", name="arm", interface=interface, channel="0", dbc="a.dbc", signals={})
    with pytest.raises(InputError, match=f"^arm, {interface} 0: ") as refused:
        make_reader(source, time.monotonic).open()
    assert "\n" not in str(refused.value)


def test_one_bad_byte_of_a_serial_adapter_is_an_error_frame() -> None:
    """slcan keeps what is no text and would raise on every later frame."""
    source = CanBus(name="bus", interface="slcan", channel="loop://", options={"sleep_after_open": 0})
    reader = CanReader(source, time.monotonic)
    reader.open()
    port = reader._bus.serialPortOrig  # type: ignore[union-attr]
    try:
        reader.read(0.05)  # what it wrote itself comes back
        port.write(b"t12320102\r")
        assert received(reader, 1).id.tolist() == [0x123]
        port.write(b"t123\xff0102\r")
        assert received(reader, 1).flags.tolist() == [ERROR_FRAME]
        port.write(b"t12320102\r")
        assert received(reader, 1).data[0, :2].tolist() == [1, 2]
        port.write(b"txyz\r" * (MOST_GARBLED + 1))
        assert (received(reader, MOST_GARBLED + 1).flags == ERROR_FRAME).all()
        with pytest.raises(LostDevice, match="nothing but garbage"):
            reader.read(0.1)
    finally:
        reader.close()


def drive(interface: dict[str, object]) -> CanSource:
    names = {"POSITION": "q_1", "VELOCITY": "rate", "TORQUE": "force_1"}
    signals = {f"AK80_REPLY.{name}": channel for name, channel in names.items()}
    table = {"kind": "can", "name": "drive", "dbc": "ak80.dbc", "signals": signals}
    return CanSource.model_validate(table | interface)


def played(source: CanSource, run: str, speed: float) -> NDArray[np.float64]:
    """A candump's frames sent onto a bus and read live on it, decoded; speed: of the recorded one."""
    logged = list(open_log(DATA / f"{run}.log"))
    frames = concatenate_frames([part.frames for part in logged])
    reader, decoder, node = make_reader(source, time.monotonic), make_decoder(source, None), open_bus(source)
    reader.open()

    def send() -> None:
        began = time.monotonic()
        for t, word in zip((frames.arrival / speed).tolist(), frames.data, strict=True):
            time.sleep(max(0.0, began + t - time.monotonic()))
            node.send(can.Message(arbitration_id=0, is_extended_id=False, data=bytes(word[:6])))

    sender = threading.Thread(target=send)
    sender.start()
    try:
        values = decoder.push(received(reader, len(frames), patience=60.0)).values
    finally:
        sender.join()
        reader.close()
        node.shutdown()
    assert not any(decoder.counters.values())
    return values


@pytest.mark.skipif(not DATA.is_dir(), reason="the AK80 pendulum's measurements are not at hand (shared/data)")
@pytest.mark.parametrize("interface", [{"interface": "virtual", "channel": "ak80"}, UDP])
@pytest.mark.parametrize("speed", [50.0, pytest.param(1.0, marks=[pytest.mark.realtime, pytest.mark.long])])
def test_real_words_on_a_bus_equal_the_published_numbers(interface: dict[str, object], speed: float) -> None:
    """The pendulum's candump, read and decoded live: every sample."""
    published = np.loadtxt(DATA / "energy_shaping.csv", delimiter=",", skiprows=1)
    decoded = played(drive(interface), "energy_shaping", speed)
    assert len(decoded) == len(published) == 4000
    # The published numbers are raw * range / steps, the DBC's raw * (range / steps): one rounding apart.
    assert (np.abs(decoded - published[:, 1:]) <= np.spacing([95.5, 45.0, 18.0])).all()
