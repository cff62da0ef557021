"""A terminal that is closed, or an ssh connection that is lost, while a session runs: its results are written."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest

from sms_tools.interruption import Interruption
from tests.axis import AXIS, capture_lines
from tests.test_killed_processes import described_testbed, kill

pytestmark = pytest.mark.realtime
PATIENCE = 40.0  # s, of a loaded machine


@pytest.fixture(autouse=True)
def hangup_is_heeded() -> Iterator[None]:
    """Also where the tests themselves run under nohup, whose sessions heed none."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    """Both ends of a terminal; the first one may be closed meanwhile."""
    ends = pty.openpty()
    termios.tcsetwinsize(ends[0], (24, 100))
    yield ends
    os.close(ends[1])


CASES = {
    # What each says when it runs, writes and returns; devices that are not there are waited for.
    "live": (["--system", "testbed.toml"], "samples/s", "report.html", 130),
    "record": (["--serial", "absent"], "absent: gone", "session.toml", 1),
    "replay": (["run.csv", "--system", "axis.toml", "--speed", "1"], "run.csv", "report.html", 130),
}


@pytest.mark.parametrize(
    "verb", ["live", *(pytest.param(verb, marks=pytest.mark.long) for verb in ("record", "replay"))]
)
def test_a_closed_terminal_ends_a_session_with_results(tmp_path: Path, terminal: tuple[int, int], verb: str) -> None:
    arguments, running, written, code = CASES[verb]
    described_testbed(tmp_path)
    (tmp_path / "axis.toml").write_text(AXIS)
    (tmp_path / "run.csv").write_text("\n".join(capture_lines(60.0)) + "\n")
    near, far = terminal
    process = subprocess.Popen(
        [sys.executable, "-m", "sms_tools", verb, *arguments, "--out", "done"],
        cwd=tmp_path,
        start_new_session=True,
        preexec_fn=lambda: os.login_tty(os.dup(far)),
        pass_fds=[far],
    )
    try:
        said = ""
        while running not in said and process.poll() is None:
            said += os.read(near, 4096).decode(errors="replace")
        os.close(near)  # the kernel signals the session's first process
        assert process.wait(PATIENCE) == code, said
    finally:
        kill(process)
    assert (tmp_path / "done" / written).is_file()


def test_only_the_first_hangup_interrupts() -> None:
    before = signal.getsignal(signal.SIGHUP)
    with Interruption() as interruption:
        for _ in range(3):
            signal.raise_signal(signal.SIGHUP)
        assert interruption.requested
    assert signal.getsignal(signal.SIGHUP) is before


def test_a_session_under_nohup_heeds_no_hangup() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interruption() as interruption:
            signal.raise_signal(signal.SIGHUP)
            assert not interruption.requested
    finally:
        signal.signal(signal.SIGHUP, before)
