"""Every verb that has `--rerun` with every value of it, each in a process of its own, as people start it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.axis import AXIS, MOTION, capture_lines
from tests.test_killed_processes import described_testbed, kill, start_arm, start_viewer, until

PATIENCE = 60.0  # s, of a loaded machine
STAYS = "the view stays until Ctrl-C"
ARGUMENTS = {
    "demo": ["--system", "moved.toml"],
    # An arm takes up to 6 s to begin on a slow host, and without a sample there is nothing to view.
    "live": ["--system", "testbed.toml", "--duration", "14"],
    "replay": ["run.csv", "--system", "moved.toml"],
    "diagnose": ["run.csv", "--system", "moved.toml"],
    "show": ["--system", "moved.toml"],
}
WRITTEN = {"diagnose": "diagnosis.json", "show": None}


@pytest.fixture
def started(tmp_path: Path) -> Iterator[list[subprocess.Popen[Any]]]:
    """A folder with what the verbs need, and processes that do not outlive a test."""
    (tmp_path / "moved.toml").write_text((AXIS + MOTION).replace("duration = 6.0", "duration = 2.0"))
    (tmp_path / "run.csv").write_text("\n".join(capture_lines()) + "\n")
    processes: list[subprocess.Popen[Any]] = []
    yield processes
    for process in processes:
        kill(process)


def tier(verb: str, mode: str) -> tuple[pytest.MarkDecorator, ...]:
    """Of a verb with a view: served pages, whose ports are the usual ones, are for themselves."""
    return (pytest.mark.realtime,) if mode == "serve" and verb != "live" else (pytest.mark.long,)


MODES = [
    pytest.param(verb, mode, marks=tier(verb, mode))
    for verb in ARGUMENTS
    for mode in ("off", "save", "serve", "spawn", "connect")
]


@pytest.mark.slow
@pytest.mark.parametrize(("verb", "mode"), MODES)
def test_every_verb_goes_with_every_view(
    tmp_path: Path, started: list[subprocess.Popen[Any]], verb: str, mode: str
) -> None:
    choice = mode
    if mode == "connect":
        viewer, address = start_viewer()
        started.append(viewer)
        choice = f"connect={address}"
    if verb == "live":
        started.append(start_arm(described_testbed(tmp_path), 5))
    command = [sys.executable, "-m", "sms_tools", verb, *ARGUMENTS[verb], "--out", "done", "--rerun", choice]
    # A viewer finds no screen, wherever this runs: the session goes on without it and says so.
    screenless = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    with (tmp_path / "said").open("w") as said:
        process = subprocess.Popen(
            command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=said, env=screenless, start_new_session=True
        )
    started.append(process)
    output = (tmp_path / "said").read_text
    if mode == "serve":
        until(lambda: STAYS in output() or process.poll() is not None, output)
        assert STAYS in output()
        process.send_signal(signal.SIGINT)
    code = process.wait(PATIENCE)
    if (verb, mode) == ("show", "spawn"):  # there is no session that could go on
        assert (code, output().count("\n")) == (2, 1)
        assert "no screen to open a viewer on" in output()
        return
    # Of a few seconds on a busy machine nothing may be determined; Ctrl-C at the end of a live session is reported.
    assert code in ({130} if (verb, mode) == ("live", "serve") else {0, 3}), output()
    assert "Traceback" not in output()
    assert ("no view: " in output()) == (mode == "spawn"), output()
    written = WRITTEN.get(verb, "results.json")
    assert written is None or (tmp_path / "done" / written).is_file()
    assert (tmp_path / "done" / "session.rrd").exists() == (mode == "save")
