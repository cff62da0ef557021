"""The simulated arm as a process on a simulated bus, and the system file of such a testbed."""

from __future__ import annotations

import os
import select
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from time import monotonic

from sms_adapters.system_file import system_text
from sms_online.description.parse import shipped_systems
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_sim.bus_layout import BASE, DBC, MARKERS, dbc_text, source_tables
from sms_sim.plant import Plant
from sms_sim.sensors import Sensors

# A group for use within one site (RFC 2365), which python-can's bus does not let leave the machine's own network.
GROUP = "239.255.43.113"
# Of every device's clock and of the transport, as on a testbed: s, relative, s.
OFFSET, DRIFT, JITTER = 0.3, 5e-5, 2e-3
# After the arm has ended, what it sent last arrives, s.
LINGERING = 0.5


def write_testbed(name: str, system: System, grade: str | None, folder: Path) -> Path:
    """The system file of a system on a simulated bus, with its own sources or with made up ones in `folder`.

    name: shipped name or path. Raises InputError as for the simulated sensors.
    """
    if system.devices:
        if name in shipped_systems():
            raise InputError(name, "source", "a device of a real testbed", "a system without [[source]] to simulate")
        return Path(name)
    text = system_text(name)
    channels = Sensors(system, Plant(system).channels, grade, 0).channels
    ports = {port: str(folder / port) for port in (BASE, MARKERS)}
    options: dict[str, str | int] = {"interface": "udp_multicast", "channel": GROUP, "port": _free_port()}
    path = folder / "testbed.toml"
    path.write_text(text.rstrip("\n") + "\n" + source_tables(channels, options, ports), encoding="utf-8")
    (folder / DBC).write_text(dbc_text(channels), encoding="ascii")
    return path


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port: int = probe.getsockname()[1]
    return port


class SimulatedArm:
    """The process: ready when made, moving from `start` on. Raises InputError where it cannot be made.

    system: file of a testbed. further: more of its arguments, see `python -m sms_sim.bus --help`.
    """

    def __init__(self, system: Path, further: Sequence[str] = ()) -> None:
        # The same modules as here, wherever they were found.
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        command = [sys.executable, "-m", "sms_sim.bus", "--system", str(system), "--wait"]
        clocks = ["--offset", str(OFFSET), "--drift", str(DRIFT), "--jitter", str(JITTER)]
        self._process = subprocess.Popen(
            [*command, *clocks, *further],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
            text=True,
            start_new_session=True,  # Ctrl-C is for the estimator, which then ends the arm
        )
        self._ended: float | None = None
        self._stopped = False
        assert self._process.stdout is not None
        if self._process.stdout.readline() == "":
            raise InputError("the simulated arm", "", self._last_words(), "an arm that moves on its bus")

    def start(self) -> None:
        """Move."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def ended(self) -> bool:
        """Whether the motion is over and what was sent has arrived."""
        if self._ended is None:
            assert self._process.stdout is not None
            # Where it has died that is readable too.
            if not select.select([self._process.stdout], [], [], 0.0)[0]:
                return False
            self._ended = monotonic()
        return monotonic() >= self._ended + LINGERING

    def stop(self) -> None:
        """End it, now. Raises InputError where it had failed."""
        if self._stopped:
            return
        self._stopped = True
        failed = self._process.poll() not in (None, 0)
        if self._ended is None:
            self._process.terminate()
        # Where it has done all it had to, the end of its input ends it, and its ports with it.
        words = self._last_words()
        if failed:
            raise InputError("the simulated arm", "", words, "an arm that moves on its bus to the end")

    def _last_words(self) -> str:
        _, said = self._process.communicate()
        return (said.strip().splitlines() or ["it ended without a message"])[-1].removeprefix("sms_sim.bus: ")
