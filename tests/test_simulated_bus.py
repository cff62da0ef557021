"""The simulated arm on its bus, a process: it sends what its sensors measure, and the program lives on that."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from sms_adapters.can_reader import frames_of, open_bus
from sms_adapters.clock_lanes import lanes
from sms_adapters.devices import make_decoder
from sms_adapters.raw import SerialChunk, concatenate_frames
from sms_adapters.serial_decoder import FrameDecoder
from sms_adapters.session_log import read_header
from sms_adapters.system_file import load_system
from sms_online.description.parse import parse_system, shipped_text
from sms_online.description.schema import System
from sms_online.description.sources import CanSource
from sms_online.stream import Block
from sms_sim.bus_encode import DeviceClock, devices
from sms_sim.bus_layout import DBC, dbc_text, messages, serial_channels, source_tables
from sms_sim.bus_motion import HeldTorque, MovingArm
from sms_sim.plant import Plant
from sms_sim.simulate import sampled_blocks, simulate
from sms_tools.cli import main
from sms_tools.live.simulated import SimulatedArm, write_testbed
from tests.axis import AXIS, DAMPING, INERTIA, MOTION

MOVED = AXIS + MOTION


def on_a_bus(text: str, folder: Path) -> System:
    """A description on a bus that nobody has opened."""
    file = folder / "testbed.toml"
    channels = Plant(parse_system(text, file.name)).channels
    ports = {port: str(folder / port) for port in ("base", "markers")}
    file.write_text(text + source_tables(channels, {"interface": "virtual", "channel": "test"}, ports))
    (folder / DBC).write_text(dbc_text(channels))
    return load_system(str(file))


@pytest.mark.parametrize("name", ["paper-planar", "spatial-two-link", "seven-joint", "emps"])
def test_a_made_up_bus_carries_each_channel_once(name: str, tmp_path: Path) -> None:
    system = on_a_bus(shipped_text(name), tmp_path)
    channels = Plant(system).channels
    carried = [channel for lane in lanes(system, tmp_path) for channel in lane.decoder.channels]
    assert sorted(carried) == sorted(channels)
    assert all(1 <= len(group) <= 2 for group in messages(channels))
    assert "base" not in serial_channels(("q_1",))


def test_frames_decode_to_the_samples_that_were_encoded(tmp_path: Path) -> None:
    system = on_a_bus(shipped_text("paper-planar"), tmp_path)
    blocks = list(sampled_blocks(simulate(system, 0.2), "B", seed=1))
    block = blocks[0]
    clock = DeviceClock(offset=0.3, drift=5e-5)
    can_devices, serial_devices = devices(system, tmp_path, [clock] * 3)
    sent = concatenate_frames([frames for _, frames in can_devices[0].encode(block)])
    decoded = make_decoder(system.sources[0], tmp_path).push(sent)
    source = system.sources[0]
    assert isinstance(source, CanSource)
    for column, described in enumerate(source.signals.values()):
        got = decoded.values[:, column]
        step = 1e-5 if described.channel.startswith("tau") else 1e-6
        expected = block.values[:, block.channels.index(described.channel)]
        np.testing.assert_allclose(got[~np.isnan(got)], expected, rtol=0, atol=0.5001 * step)
    for device, port in zip(serial_devices, system.sources[1:], strict=True):
        decoder = make_decoder(port, tmp_path)
        assert isinstance(decoder, FrameDecoder)
        t, frames = device.encode(block)
        samples = decoder.push(SerialChunk(0.0, b"".join(frames)))
        columns = [block.channels.index(channel) for channel in decoder.channels]
        np.testing.assert_array_equal(samples.values, block.values[:, columns])
        # Before the device's own zero its clock shows the end of its last round.
        shown = np.mod(samples.t_device - clock(t) + 100.0, 2.0**32 * 1e-6) - 100.0
        np.testing.assert_allclose(shown, 0.0, atol=0.51e-6)


def test_a_reading_beyond_the_range_of_its_word_saturates(tmp_path: Path) -> None:
    system = on_a_bus(MOVED, tmp_path)
    block = Block(np.zeros(3), ("force_1", "q_1"), np.array([[1e5, 100.0], [-1e5, -100.0], [1.0, 1.0]]))
    (device,), _ = devices(system, tmp_path, [DeviceClock()])
    frames = concatenate_frames([frames for _, frames in device.encode(block)])
    values = make_decoder(system.sources[0], tmp_path).push(frames).values
    assert np.nanmax(values, axis=0).tolist() == pytest.approx([8388.607, 8.388607])
    assert np.nanmin(values, axis=0).tolist() == pytest.approx([-8388.608, -8.388608])


def test_the_moving_arm_is_the_simulated_one() -> None:
    system = parse_system(MOVED, "moved.toml")
    moving = list(MovingArm(system, 1.0, "A", seed=3))
    exact = list(sampled_blocks(simulate(system, 1.0), "A", seed=3))
    assert np.concatenate([b.t for b in moving]).tolist() == np.concatenate([b.t for b in exact]).tolist()
    got, expected = (np.concatenate([b.values for b in blocks]) for blocks in (moving, exact))
    # Steps of a millisecond, against an adaptive integrator.
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6)


def test_an_arm_under_command_obeys() -> None:
    system = parse_system(AXIS, "axis.toml")
    held = HeldTorque(1)
    held.torque = np.array([0.3])
    blocks = list(MovingArm(system, 1.0, "0", seed=0, commanded=held))
    q = np.concatenate([block.values[:, block.channels.index("q_1")] for block in blocks])
    t = np.concatenate([block.t for block in blocks])
    # I q'' + b q' = τ from rest.
    rate = DAMPING / INERTIA
    expected = 0.3 / DAMPING * (t - (1.0 - np.exp(-rate * t)) / rate)
    np.testing.assert_allclose(q, expected, rtol=0, atol=1e-8)


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[tuple[SimulatedArm, Path]]:
    """The axis on a bus of its own, ready to move, and its system file."""
    (tmp_path / "moved.toml").write_text(MOVED)
    system = load_system(str(tmp_path / "moved.toml"))
    file = write_testbed(str(tmp_path / "moved.toml"), system, "A", tmp_path)
    arm = SimulatedArm(file, ["--grade", "A", "--seed", "5"])
    yield arm, file
    arm.stop()


def live(file: Path, out: Path, *further: str) -> subprocess.Popen[str]:
    """The live verb as a process, its devices open."""
    command = [sys.executable, "-m", "sms_tools", "live", "--system", str(file), "--out", str(out), *further]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 30.0
    while not (out / "session.toml").exists():
        assert time.monotonic() < end
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    time.sleep(1.0)
    return process


def document(directory: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((directory / "results.json").read_text())
    del found["throughput_samples_per_s"]
    return found


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)])
def test_a_stopped_live_session_replays_to_the_same_results(
    arm: tuple[SimulatedArm, Path], tmp_path: Path, number: signal.Signals
) -> None:
    moving, file = arm
    process = live(file, tmp_path / "run", "--tracker", "kalman:drift=learned", "--tracker", "rls")
    moving.start()
    time.sleep(5.0)
    os.kill(process.pid, number)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 130, err
    assert "link_1.inertia" in out
    assert "samples/s" in err
    files = {path.name for path in (tmp_path / "run").iterdir()}
    assert files >= {"session.toml", "system.toml", DBC, "can.log", "results.json", "checkpoint.msgpack"}
    system = str(tmp_path / "run" / "system.toml")
    assert main(["replay", str(tmp_path / "run"), "--system", system, "--out", str(tmp_path / "again")]) in (0, 3)
    asked = [tracker.label for tracker in read_header(tmp_path / "run")[0].trackers]
    assert asked == ["kalman learned", "rls"]
    assert document(tmp_path / "again") == document(tmp_path / "run")
    assert document(tmp_path / "run")["samples"] > 1000


@pytest.mark.long
@pytest.mark.realtime
def test_after_a_kill_a_new_session_resumes(arm: tuple[SimulatedArm, Path], tmp_path: Path) -> None:
    moving, file = arm
    process = live(file, tmp_path / "killed")
    moving.start()
    end = time.monotonic() + 30.0
    while not (tmp_path / "killed" / "checkpoint.msgpack").exists():
        assert time.monotonic() < end
        time.sleep(0.1)
    process.kill()
    process.communicate()
    assert main(["replay", str(tmp_path / "killed"), "--system", str(file), "--out", str(tmp_path / "read")]) == 0
    assert "killed: the session was killed; this is what was on disk" in document(tmp_path / "read")["warnings"]
    moving.stop()
    again = SimulatedArm(file, ["--grade", "A", "--seed", "6"])
    process = live(file, tmp_path / "run", "--resume", str(tmp_path / "killed"), "--duration", "9")
    again.start()
    _, err = process.communicate(timeout=40)
    again.stop()
    assert process.returncode == 0, err
    whole, first = document(tmp_path / "run"), document(tmp_path / "read")
    assert whole["samples"] > first["samples"]
    for p, true in zip(whole["parameters"], (INERTIA, DAMPING), strict=True):
        assert abs(p["estimate"] - true) < 4.0 * p["std"]
    assert main(["replay", str(tmp_path / "run"), "--system", str(file), "--out", str(tmp_path / "again")]) == 0
    assert document(tmp_path / "again") == whole


@pytest.mark.realtime
def test_record_needs_no_system_file(
    arm: tuple[SimulatedArm, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moving, file = arm
    source = load_system(str(file)).sources[0]
    assert isinstance(source, CanSource)
    # python-can's own port for such groups, so that three words describe the bus.
    text = file.read_text().replace(f"port = {source.options['port']}", "port = 43113")
    moving.stop()
    file.write_text(text)
    again = SimulatedArm(file, ["--grade", "A"])
    again.start()
    bus = f"can={source.interface}:{source.channel}"
    assert main(["record", "--can", bus, "--duration", "4", "--out", str(tmp_path / "run"), "--json"]) == 0
    again.stop()
    said = json.loads(capsys.readouterr().out)
    assert said["sources"]["can"] > 500
    assert not (tmp_path / "run" / "system.toml").exists()
    assert main(["replay", str(tmp_path / "run"), "--system", str(file), "--out", str(tmp_path / "read")]) in (0, 3)
    assert document(tmp_path / "read")["samples"] > 500


def test_devices_that_cannot_be_recorded_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "--out", str(tmp_path / "run")]) == 2
    assert main(["record", "--can", "can0", "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert "expected --can or --serial, once for each device" in said
    assert "expected [NAME=]INTERFACE:CHANNEL[:BITRATE]" in said


def test_live_needs_sources(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "axis.toml").write_text(AXIS)
    assert main(["live", "--system", str(tmp_path / "axis.toml"), "--out", str(tmp_path / "run")]) == 2
    assert "[[source]] for each device" in capsys.readouterr().err


@pytest.mark.realtime
def test_frames_reach_another_node_of_the_bus(arm: tuple[SimulatedArm, Path]) -> None:
    moving, file = arm
    source = load_system(str(file)).sources[0]
    assert isinstance(source, CanSource)
    bus = open_bus(source)
    moving.start()
    received = [bus.recv(5.0) for _ in range(50)]
    bus.shutdown()
    assert [message.dlc for message in received if message is not None] == [8] * 50


@pytest.mark.realtime
def test_an_arm_on_the_bus_obeys_torque_commands(tmp_path: Path) -> None:
    (tmp_path / "axis.toml").write_text(AXIS)
    file = write_testbed(str(tmp_path / "axis.toml"), load_system(str(tmp_path / "axis.toml")), "0", tmp_path)
    source = load_system(str(file)).sources[0]
    assert isinstance(source, CanSource)
    arm = SimulatedArm(file, ["--commanded", "--grade", "0", "--duration", "3"])
    bus = open_bus(source)
    decoder = make_decoder(source, tmp_path)
    force, q = (decoder.channels.index(name) for name in ("force_1", "q_1"))
    arm.start()
    # A thousand counts of 1e-3 N m, in the first 24 bits of the command.
    bus.send(can.Message(arbitration_id=0x080, data=(1000).to_bytes(3, "little") + bytes(3), is_extended_id=False))
    rows = []
    while not arm.ended():
        message = bus.recv(0.1)
        if message is not None and message.arbitration_id != 0x080:
            rows.append(decoder.push(frames_of([message], np.zeros(1))).values)
    bus.shutdown()
    arm.stop()
    values = np.concatenate(rows)
    torque, angle = (values[~np.isnan(values[:, k]), k] for k in (force, q))
    assert torque[-1] == pytest.approx(1.0)
    assert angle[-1] > 1.0
