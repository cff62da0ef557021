"""`--rerun serve`: who can reach it, and that it ends with its session, however that ends."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
from rerun.blueprint import Blueprint

from sms_tools.view.choice import Choice
from sms_tools.view.sink import Sink
from tests.axis import AXIS, capture_lines
from tests.test_killed_processes import kill, until

pytestmark = pytest.mark.realtime
STAYS = "the view stays until Ctrl-C"


@pytest.fixture
def started(tmp_path: Path) -> Iterator[list[subprocess.Popen[Any]]]:
    """A folder with a session to replay, and processes that do not outlive a test."""
    (tmp_path / "axis.toml").write_text(AXIS)
    (tmp_path / "run.csv").write_text("\n".join(capture_lines()) + "\n")
    processes: list[subprocess.Popen[Any]] = []
    yield processes
    for process in processes:
        kill(process)


def serve(folder: Path, started: list[subprocess.Popen[Any]], choice: str) -> tuple[str, int, int]:
    """A replay that is served: what it said, the ports of its page and of its data."""
    replay = ["replay", "run.csv", "--system", "axis.toml", "--out", "done", "--rerun", choice]
    with (folder / "said").open("w") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "sms_tools", *replay], cwd=folder, stdout=subprocess.DEVNULL, stderr=file
        )
    started.append(process)
    output = (folder / "said").read_text
    until(lambda: STAYS in output() or process.poll() is not None, output)
    assert STAYS in output()
    found = re.search(r"http://\S+", output())
    assert found is not None
    page = urlsplit(found[0])
    data = urlsplit(unquote(page.query).removeprefix("url="))
    assert page.port is not None
    assert data.port is not None
    return output(), page.port, data.port


def listens(address: str, port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((address, port)) == 0


@pytest.mark.parametrize(("choice", "others"), [("serve", False), ("serve=0.0.0.0", True)])
def test_only_this_machine_reaches_a_view_unless_asked_for(
    tmp_path: Path, started: list[subprocess.Popen[Any]], choice: str, others: bool
) -> None:
    said, *ports = serve(tmp_path, started, choice)
    for port in ports:
        assert listens("127.0.0.1", port)
        # Linux answers at all of 127/8, as at the addresses of the network, where a server is bound to all of them.
        assert listens("127.0.0.2", port) == others
    assert ("open to the whole network" in said) == others
    started[0].send_signal(signal.SIGINT)
    assert started[0].wait(20.0) == 0
    until(lambda: not any(listens("127.0.0.1", port) for port in ports), lambda: "it is served still")


def test_a_spawned_viewer_listens_to_this_machine_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class StartedError(Exception):
        """Carries the command of a process in place of starting it."""

    def start(command: list[str], **_: object) -> None:
        raise StartedError(command)

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(subprocess, "Popen", start)
    with pytest.raises(StartedError) as started:
        Sink(Choice("spawn"), tmp_path / "none.rrd", "test").open(Blueprint())
    command = started.value.args[0]
    assert command[command.index("--bind") + 1] == "127.0.0.1"


def test_nothing_serves_on_when_a_session_is_killed(tmp_path: Path, started: list[subprocess.Popen[Any]]) -> None:
    _, *ports = serve(tmp_path, started, "serve")
    kill(started[0])
    until(lambda: not any(listens("127.0.0.1", port) for port in ports), lambda: "it is served still")
