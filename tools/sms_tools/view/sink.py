"""Where the view goes: one rerun recording stream with one sink, which never waits for ever.

A rerun sink whose other end is gone or does not read first buffers, then blocks, and tells of a full disk only in its
own log; a flush with a time limit after every batch finds out all of this.
"""

from __future__ import annotations

import socket
import sys
from pathlib import Path
from urllib.parse import quote

import rerun as rr
import rerun.blueprint as rrb

from sms_tools.view.choice import Choice
from sms_tools.view.frames import TroubleError

# One name for all sessions: the viewer keeps what a person changes in the layout by application.
APPLICATION = "sms_online"
# A batch that is not taken within this time, s, never will be.
FLUSH_TIMEOUT = 3.0
# What a served session keeps for viewers that come late; the oldest goes first.
SERVER_MEMORY = "512MiB"
GRPC_PORT, WEB_PORT = 9876, 9090


class Sink:
    """A recording stream and its only sink."""

    def __init__(self, choice: Choice, recording: Path, title: str) -> None:
        self.choice = choice
        self.stream = rr.RecordingStream(APPLICATION, make_default=False)
        self.stream.send_recording_name(title)
        self._file = recording

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
        if kind == "spawn":
            # The viewer stands beside the interpreter, whether or not that directory is in PATH.
            viewer = Path(sys.executable).with_name("rerun")
            rr.spawn(
                recording=self.stream,
                port=_free_port(GRPC_PORT),
                executable_path=str(viewer) if viewer.exists() else None,
                default_blueprint=blueprint,
            )
            return "showing in a rerun viewer"
        server = self.stream.serve_grpc(
            grpc_port=_free_port(GRPC_PORT), default_blueprint=blueprint, server_memory_limit=SERVER_MEMORY
        )
        port = _free_port(WEB_PORT)
        rr.serve_web_viewer(web_port=port, open_browser=False, connect_to=server)
        # rerun binds both servers to all interfaces and offers no other choice.
        return f"in the browser: http://127.0.0.1:{port}/?url={quote(server, safe='')} (open to the whole network)"

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

    def close(self) -> None:
        """Complete a recording's file; only after a flush that worked, for this waits without a limit."""
        if self.choice.kind == "save":
            self.stream.disconnect()


def _free_port(wanted: int) -> int:
    """The wanted port, or any free one where that is taken."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("", port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise TroubleError("no free port")
