"""Where the view goes: one rerun recording stream with one sink, which never waits for ever.

A rerun sink whose other end is gone or does not read first buffers, then blocks, and reports a full disk only in its
own log; a flush with a time limit after every batch finds out all of this.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from ipaddress import ip_address
from pathlib import Path
from time import monotonic, sleep
from urllib.parse import quote

import rerun as rr
import rerun.blueprint as rrb
import rerun_cli

from sms_tools.view.choice import LOOPBACK, Choice
from sms_tools.view.frames import TroubleError

# One name for all sessions: the viewer keeps what a person changes in the layout by application.
APPLICATION = "sms_online"
# A batch that is not taken within this time, s, never will be.
FLUSH_TIMEOUT = 3.0
# What a served session keeps for viewers that come late; the oldest goes first.
SERVER_MEMORY = "512MiB"
GRPC_PORT, WEB_PORT = 9876, 9090
# The viewer and server itself; the script of that name starts it as a child, which would outlive its parent.
RERUN = Path(rerun_cli.__file__).with_name("rerun")
# Where a viewer finds a screen, on Linux.
SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
# A server listens within this time, s, also on a busy machine, and is tried so often, s.
STARTING, TRY = 20.0, 0.05


class Sink:
    """A recording stream and its only sink."""

    def __init__(self, choice: Choice, recording: Path, title: str) -> None:
        self.choice = choice
        self.stream = rr.RecordingStream(APPLICATION, make_default=False)
        self.stream.send_recording_name(title)
        self._file = recording
        self._server: subprocess.Popen[bytes] | None = None

    def open(self, blueprint: rrb.Blueprint) -> str:
        """Connect with this layout; returns where the view is to be found, a sentence."""
        kind = self.choice.kind
        if kind == "save":
            self.stream.save(self._file, default_blueprint=blueprint)
            return f"recording to {self._file}"
        if kind == "connect":
            # Somebody listens there, or this would take seconds and then look like success.
            self.stream.connect_grpc(self.choice.url, default_blueprint=blueprint)
            return f"showing in the viewer at {self.choice.url}"
        return self._spawn(blueprint) if kind == "spawn" else self._serve(blueprint)

    def _spawn(self, blueprint: rrb.Blueprint) -> str:
        """Start a viewer that outlives the session; rerun's own `spawn` lets it listen to the whole network."""
        if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in SCREENS):
            # The viewer would listen, take the first data, and die.
            raise TroubleError("no screen to open a viewer on; --rerun serve shows it in a browser")
        port = free_port(GRPC_PORT, LOOPBACK)
        command = [str(RERUN), "--bind", LOOPBACK, "--port", str(port), "--expect-data-soon"]
        viewer = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
        self._await_listening(viewer, LOOPBACK, port, "rerun's viewer does not start")
        self.stream.connect_grpc(f"rerun+http://{LOOPBACK}:{port}/proxy", default_blueprint=blueprint)
        return "showing in a rerun viewer"

    def _await_listening(self, process: subprocess.Popen[bytes], address: str, port: int, otherwise: str) -> None:
        end = monotonic() + STARTING
        while not _listens(address, port):
            if process.poll() is not None or monotonic() > end:
                raise TroubleError(otherwise)
            sleep(TRY)

    def _serve(self, blueprint: rrb.Blueprint) -> str:
        """Start a server of pages and data, as a process of its own, for within this one it has no address to choose.

        It stays in this process's group, with which the session ends it.
        """
        address = self.choice.host
        port, page = free_port(GRPC_PORT, address), free_port(WEB_PORT, address)
        command = [str(RERUN), "--serve-web", "--bind", address, "--server-memory-limit", SERVER_MEMORY]
        command += ["--port", str(port), "--web-viewer-port", str(page)]
        open_to_others = not ip_address(address).is_loopback
        if open_to_others:
            command += ["--cors-allow-origin", f"http://*:{page}"]  # pages that are asked for by this machine's name
        self._server = server = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        reached = LOOPBACK if address == "0.0.0.0" else address
        self._await_listening(server, reached, port, f"rerun's server does not start on {address}")
        data = f"rerun+http://{reached}:{port}/proxy"
        self.stream.connect_grpc(data, default_blueprint=blueprint)
        url = f"http://{reached}:{page}/?url={quote(data, safe='')}"
        if address == "0.0.0.0":
            return f"in the browser: {url} (open to the whole network: elsewhere this machine's name for {LOOPBACK})"
        return f"in the browser: {url}"

    def arrange(self, blueprint: rrb.Blueprint) -> None:
        """Show in another layout from now on."""
        self.stream.send_blueprint(blueprint)

    def flush(self) -> None:
        """Wait until the data are out; TroubleError where they do not get there."""
        try:
            self.stream.flush(timeout_sec=FLUSH_TIMEOUT)
        except RuntimeError:
            whats_wrong = {
                "save": f"{self._file} cannot be written any further (a full disk?)",
                "connect": f"the viewer at {self.choice.url} is gone or does not read",
                "spawn": "the viewer is gone or does not read",
            }
            raise TroubleError(whats_wrong.get(self.choice.kind, "the server does not take data")) from None

    @property
    def serving(self) -> bool:
        """Whether a server of this sink runs."""
        return self._server is not None and self._server.poll() is None

    def end_server(self) -> None:
        """Stop serving."""
        if self._server is not None:
            self._server.terminate()
            self._server.wait()

    def close(self) -> None:
        """Complete a recording's file; only after a flush that worked, for this waits without a limit."""
        if self.choice.kind == "save":
            self.stream.disconnect()


def _listens(address: str, port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((address, port)) == 0


def free_port(wanted: int, address: str) -> int:
    """The wanted port at an address of this machine, or any free one where that is taken."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise TroubleError("no free port")
