"""Frames of a motion capture that come over the network, against frames written by the tests."""

from __future__ import annotations

import math
import os
import socket
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sms_online as sms
from sms_adapters.devices import make_decoder, make_reader
from sms_adapters.raw import CanFrames, Decoder, LostDevice, Raw, SerialChunk
from sms_adapters.recorder import Recorder
from sms_adapters.recording import Recording
from sms_adapters.session_log import RecordedItems, SessionHeader
from sms_online.description.parse import parse_system
from sms_online.description.sources import NatnetSource
from tests.axis import DAMPING, INERTIA
from tests.bus_streams import SOURCES, AxisBus, axis_testbed
from tests.natnet_frames import MODEL, OCCLUDED, POINT_CLOUD, Body, Mark, frame, message
from tests.refused import RIG

SIGNALS = {
    "1.x": "r_S_x",
    "1.y": {"channel": "r_S_y", "scale": -1.0},
    "1.yaw": "theta_0",
    "3.2.x": "link_1.marker_2.x",
    "3.2.z": "link_1.marker_2.y",
}
VERSIONS = [(2, 9), (3, 0), (3, 1), (4, 0), (4, 1)]
GROUP, PORT = "239.74.163.9", 21_000 + os.getpid() % 20_000


def source(version: str = "3.1", **stated: Any) -> NatnetSource:
    given = {"kind": "udp", "format": "natnet", "name": "cameras", "signals": SIGNALS, "version": version}
    return NatnetSource.model_validate(given | stated)


def decoder(version: tuple[int, int] = (3, 1)) -> Decoder:
    return make_decoder(source("{}.{}".format(*version)), None)


def sent(k: int, version: tuple[int, int] = (3, 1), bits: int = POINT_CLOUD, tracked: bool = True) -> bytes:
    """Frame k, of a body that turns about z by 0.4 rad a frame."""
    half = 0.2 * k
    base = Body(1, (0.5 * k, 0.25, 1.0), (0.0, 0.0, math.sin(half), math.cos(half)), tracked)
    marks = [Mark(3, 1, (7.0, 7.0, 7.0)), Mark(3, 2, (0.125 * k, 2.0, -0.5), bits), Mark(4, 2, (8.0, 8.0, 8.0))]
    return frame(100 + k, 50.0 + k / 240.0, [base, Body(2, (6.0, 6.0, 6.0))], marks, version)


def chunks(datagrams: list[bytes]) -> list[Raw]:
    return [SerialChunk(0.01 * k, data) for k, data in enumerate(datagrams)]


@pytest.mark.parametrize("version", VERSIONS)
def test_frames_of_every_version_are_read(version: tuple[int, int]) -> None:
    reads = decoder(version)
    samples = reads.push(*chunks([sent(k, version) for k in range(20)]))
    k = np.arange(20.0)
    expected = [0.5 * k, np.full(20, -0.25), 0.4 * k, 0.125 * k, np.full(20, -0.5)]
    assert reads.channels == ("r_S_x", "r_S_y", "theta_0", "link_1.marker_2.x", "link_1.marker_2.y")
    np.testing.assert_allclose(samples.values, np.stack(expected, axis=1), atol=1e-5)
    np.testing.assert_array_equal(samples.t_device, 50.0 + k / 240.0)
    np.testing.assert_array_equal(samples.t_arrival, 0.01 * k)
    assert not any(reads.counters.values())


def test_the_grouping_of_datagrams_changes_nothing() -> None:
    datagrams, whole, single = [sent(k) for k in range(12)], decoder(), decoder()
    together = whole.push(*chunks(datagrams))
    apart = [single.push(chunk) for chunk in chunks(datagrams)]
    np.testing.assert_array_equal(together.values, np.concatenate([each.values for each in apart]))


@pytest.mark.parametrize("bits", [OCCLUDED, OCCLUDED | MODEL, MODEL])
def test_what_cameras_did_not_see_is_no_sample(bits: int) -> None:
    reads = decoder()
    samples = reads.push(*chunks([sent(0), sent(1, bits=bits), sent(2, tracked=False)]))
    missing = np.isnan(samples.values)
    assert missing.tolist() == [[False] * 5, [False] * 3 + [True] * 2, [True] * 3 + [False] * 2]
    assert reads.counters["hidden"] == 2
    assert reads.push(SerialChunk(1.0, sent(3, bits=bits, tracked=False))).values.shape == (0, 5)


def test_lost_and_repeated_frames_are_counted() -> None:
    reads = decoder()
    samples = reads.push(*chunks([sent(0), sent(1), sent(1), sent(5)]))
    assert samples.t_device.tolist() == [50.0 + k / 240.0 for k in (0, 1, 5)]
    assert (reads.counters["lost_counter"], reads.counters["repeated_counter"]) == (3, 1)


def test_other_messages_pass_and_damaged_ones_are_counted() -> None:
    reads = decoder()
    cut = sent(1)[:-7]
    samples = reads.push(*chunks([message(5, b"descriptions"), b"", cut, sent(2)]))
    assert samples.t_device.tolist() == [50.0 + 2 / 240.0]
    assert reads.counters["bad_frame"] == 2
    assert reads.counters["lost_counter"] == 0
    with pytest.raises(TypeError, match="CanFrames"):
        reads.push(CanFrames(*([np.empty(0)] * 6)))  # type: ignore[arg-type]


@pytest.mark.parametrize(("stated", "sends"), [((3, 1), (4, 1)), ((4, 1), (3, 1)), ((2, 9), (3, 1)), ((3, 1), (2, 9))])
def test_another_version_gives_no_samples(stated: tuple[int, int], sends: tuple[int, int]) -> None:
    reads = decoder(stated)
    samples = reads.push(*chunks([sent(k, sends) for k in range(5)]))
    assert not samples.values.size
    assert reads.counters["bad_frame"] == 5


@given(st.integers(0, len(sent(0)) - 1), st.binary(max_size=12), st.integers(0, 12))
def test_no_datagram_raises(at: int, put: bytes, less: int) -> None:
    whole = sent(0)
    contents = (whole[:at] + put + whole[at + less :])[4:]
    decoder().push(*chunks([message(7, contents), put]))


def test_datagrams_of_a_group_are_read_recorded_and_replayed(tmp_path: Path) -> None:
    cameras = source(group=GROUP, port=PORT)
    reader = make_reader(cameras, time.monotonic)
    with pytest.raises(LostDevice, match="cameras: it is not open"):
        reader.read(0.0)
    reader.open()
    assert reader.read(0.01) == []
    datagrams = [sent(k) for k in range(50)]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        for data in datagrams:
            sender.sendto(data, (GROUP, PORT))
    received: list[Raw] = []
    while len(received) < 50 and (more := reader.read(2.0)):
        received += more
    reader.close()
    assert [chunk.data for chunk in received if isinstance(chunk, SerialChunk)] == datagrams
    arrivals = [SerialChunk(1e-6 * k, data) for k, data in enumerate(datagrams)]
    recorder = Recorder(tmp_path / "run", SessionHeader(0, {"cameras": "udp"}, 0.0, {}))
    recorder.put("cameras", arrivals, dropped=False)
    recorder.close(1.0, [])
    replayed = list(RecordedItems(tmp_path / "run", "cameras", "udp", 0))
    assert replayed == arrivals


@pytest.mark.slow
def test_a_recording_of_drive_and_cameras_gives_the_axis(tmp_path: Path) -> None:
    """Eight seconds of an axis whose angle cameras see, sensors' noise of seed 1."""
    drive = SOURCES.partition('[[source]]\nkind = "serial"')[0]
    system = axis_testbed(tmp_path, drive + CAMERAS)
    bus = AxisBus(seconds=8.0, offset=0.3)
    turns = np.stack((np.sin(bus.angle / 2.0), np.cos(bus.angle / 2.0)), axis=1).tolist()
    datagrams = [
        SerialChunk(arrival, frame(k, t, [Body(2, (0.0, 0.0, 0.0), (0.0, 0.0, z, w))], []))
        for k, (arrival, t, (z, w)) in enumerate(
            zip(bus.encoder_arrival.tolist(), bus.ticks.tolist(), turns, strict=True)
        )
    ]
    recorder = Recorder(tmp_path / "run", SessionHeader(0, {"drive": "can", "cameras": "udp"}, 0.0, {}))
    recorder.put("drive", [bus.drive()], dropped=False)
    recorder.put("cameras", datagrams, dropped=False)
    recorder.close(9.0, [])
    result = sms.estimate(system, Recording(tmp_path / "run", system, tmp_path))
    for p, true in zip(result.parameters.values(), (INERTIA, DAMPING), strict=True):
        assert p.determined
        assert abs(p.value - true) < 4.0 * p.std < 0.02 * true


def test_a_port_that_is_taken_is_a_lost_device() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        reader = make_reader(source(group="", interface="127.0.0.1", port=other.getsockname()[1]), time.monotonic)
        with pytest.raises(LostDevice, match="cameras: "):
            reader.open()


def test_without_its_package_the_source_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "natnet", None)
    with pytest.raises(sms.InputError, match=r"source cameras.*sms-online\[natnet\]"):
        decoder()


CAMERAS = """
[[source]]
kind = "udp"
format = "natnet"
name = "cameras"
version = "3.1"
latency = 0.005
signals = { "2.yaw" = "q_1" }
"""


@pytest.mark.parametrize(
    ("stated", "wrong", "message"),
    [
        ('"2.yaw"', '"2.roll"', r"source 1.signals: '2.roll'; expected \"ASSET.PART\""),
        ('"2.yaw"', '"2.0.x"', "source 1.signals: '2.0.x'"),
        ('"3.1"', '"three"', "version"),
        ('name = "cameras"', 'name = "cameras"\ngroup = "10.0.0.1"', "group: '10.0.0.1'; expected a multicast address"),
        ('name = "cameras"', 'name = "cameras"\ninterface = "eth0"', "interface: 'eth0'; expected an IPv4 address"),
        ('"q_1"', '"q_2"', "unknown channel 'q_2'"),
    ],
)
def test_a_wrong_description_is_refused(stated: str, wrong: str, message: str) -> None:
    assert parse_system(RIG + CAMERAS, "rig.toml").sources
    with pytest.raises(sms.InputError, match=message):
        parse_system(RIG + CAMERAS.replace(stated, wrong, 1), "rig.toml")
