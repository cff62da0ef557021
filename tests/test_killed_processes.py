"""kill -9 of what runs beside a live session: the arm, the view's process, a viewer; the session goes on."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rerun_cli

from sms_tools.cli import main
from sms_tools.live.simulated import GROUP, SimulatedArm
from tests.axis import AXIS, DAMPING, INERTIA, MOTION
from tests.bus_streams import DBC, SOURCES

pytestmark = pytest.mark.realtime
PATIENCE = 40.0  # s, of a loaded machine
LATENCY = 0.003  # s, of every source
ENOUGH = 500  # samples of the encoder, for both parameters


def described_testbed(folder: Path) -> Path:
    """The axis, its drive on CAN and its encoder on a serial port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    bus = f'interface = "udp_multicast"\nchannel = "{GROUP}"\noptions = {{ port = {port} }}'
    sources = SOURCES.replace('interface = "virtual"', bus).replace("/dev/null", str(folder / "encoder"))
    sources = sources.replace("latency = 0.005", f"latency = {LATENCY}")
    (folder / "axis.dbc").write_text(DBC)
    (folder / "testbed.toml").write_text(AXIS + MOTION + sources)
    return folder / "testbed.toml"


class Session:
    """A live session as a process, and what it has said on stderr so far."""

    def __init__(self, system: Path, out: Path, started: list[subprocess.Popen[Any]], *further: str) -> None:
        command = [sys.executable, "-m", "sms_tools", "live", "--system", str(system), "--out", str(out), *further]
        self.out = out
        self._said = (out.parent / f"{out.name}.stderr").open("w+")
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=self._said, text=True)
        started.append(self.process)

    @property
    def said(self) -> str:
        return Path(self._said.name).read_text()

    def wait_for(self, what: str) -> None:
        """Until it has said so."""
        until(lambda: what in self.said or self.process.poll() is not None, lambda: self.said)
        assert what in self.said

    def end(self) -> dict[str, Any]:
        """Ctrl-C; the document."""
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(PATIENCE) == 130, self.said
        document: dict[str, Any] = json.loads((self.out / "results.json").read_text())
        return document


def until(condition: Callable[[], bool], otherwise: Callable[[], str]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, otherwise()
        time.sleep(0.05)


@pytest.fixture
def started() -> Iterator[list[subprocess.Popen[Any]]]:
    """Processes that do not outlive a test."""
    processes: list[subprocess.Popen[Any]] = []
    yield processes
    for process in processes:
        kill(process)


def kill(process: subprocess.Popen[Any]) -> None:
    process.kill()
    process.wait()


def start_arm(file: Path, seed: int) -> subprocess.Popen[str]:
    arm = SimulatedArm(file, ["--grade", "A", "--seed", str(seed), "--latency", str(LATENCY), "--duration", "30"])
    arm.start()
    return arm._process


def assert_right(document: dict[str, Any]) -> None:
    for p, true in zip(document["parameters"], (INERTIA, DAMPING), strict=True):
        assert abs(p["estimate"] - true) < 4.0 * p["std"]
        assert p["identifiable"]


def samples(session: Session) -> int:
    """Lines of the encoder's raw log."""
    path = session.out / "encoder.serial"
    return len(path.read_text().splitlines()) if path.is_file() else 0


@pytest.mark.long
def test_a_killed_arm_is_named_and_followed_when_it_moves_again(
    tmp_path: Path, started: list[subprocess.Popen[Any]]
) -> None:
    file = described_testbed(tmp_path)
    started.append(start_arm(file, 5))
    session = Session(file, tmp_path / "run", started)
    until(lambda: samples(session) > ENOUGH, lambda: session.said)
    kill(started[0])
    session.wait_for("encoder: gone (")
    session.wait_for("drive: silent")
    before = samples(session)
    started.append(start_arm(file, 6))
    until(lambda: samples(session) > before + ENOUGH, lambda: session.said)
    document = session.end()
    assert any(w.startswith("encoder: lost 1 times and opened again") for w in document["warnings"])
    assert any(w.startswith("drive: silent for more than 1 s, ") for w in document["warnings"])
    assert document["samples"] > 3 * ENOUGH  # rows of the drive and of the encoder
    assert_right(document)
    assert main(["replay", str(session.out), "--system", str(file), "--out", str(tmp_path / "again")]) == 0
    assert json.loads((tmp_path / "again" / "results.json").read_text())["parameters"] == document["parameters"]


def test_nothing_of_a_killed_arm_lives_on(tmp_path: Path, started: list[subprocess.Popen[Any]]) -> None:
    arm = start_arm(described_testbed(tmp_path), 5)
    started.append(arm)
    solving = children(arm.pid)
    assert solving
    kill(arm)
    until(lambda: not any(alive(pid) for pid in solving), lambda: f"{solving} live on")


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def start_viewer() -> tuple[subprocess.Popen[bytes], str]:
    """A rerun server without a window, and its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    # The viewer itself; the script of that name starts it as a child, which a kill of the script leaves alone.
    rerun = str(Path(rerun_cli.__file__).with_name("rerun"))
    viewer = subprocess.Popen(
        [rerun, "--serve-grpc", "--port", str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )

    def listening() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    until(listening, lambda: "no viewer")
    return viewer, f"127.0.0.1:{port}"


@pytest.mark.long
@pytest.mark.parametrize("killed", ["view", "viewer"])
def test_a_killed_view_is_named_and_the_session_goes_on(
    tmp_path: Path, started: list[subprocess.Popen[Any]], killed: str
) -> None:
    file = described_testbed(tmp_path)
    choice = "save"
    if killed == "viewer":
        viewer, address = start_viewer()
        started.append(viewer)
        choice = f"connect={address}"
    started.append(start_arm(file, 5))
    session = Session(file, tmp_path / "run", started, "--rerun", choice)
    session.wait_for("view: ")  # recording, or showing
    before = samples(session)
    if killed == "viewer":
        kill(viewer)
    else:
        os.kill(view_of(session.process.pid), signal.SIGKILL)
    session.wait_for("no view: ")
    until(lambda: samples(session) > before + ENOUGH, lambda: session.said)
    document = session.end()
    assert any(warning.startswith("the view ended at ") for warning in document["warnings"])
    assert "lost" not in "".join(document["warnings"])
    assert_right(document)


def view_of(pid: int) -> int:
    """The view's process of a session."""
    return next(child for child in children(pid) if b"view.worker" in Path(f"/proc/{child}/cmdline").read_bytes())
