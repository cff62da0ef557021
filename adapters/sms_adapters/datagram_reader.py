"""UDP datagrams, of a multicast group or sent to this machine."""

from __future__ import annotations

import select
import socket

from sms_adapters.raw import Clock, LostDevice, Raw, SerialChunk, Turn, at_once, one_line
from sms_online.description.sources import DatagramPort

# A datagram is no longer.
LONGEST = 65536
# Bytes that the operating system may hold back while the estimator computes: a second of many markers.
HELD_BACK = 1 << 21


class DatagramReader:
    """Datagrams as they come, a chunk each: a `Reader`."""

    def __init__(self, source: DatagramPort, clock: Clock, turn: Turn = at_once) -> None:
        self.name = source.name
        self._source = source
        self._clock = clock
        self._turn = turn
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """Listen; raises LostDevice where that fails."""
        self.close()
        listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, HELD_BACK)
            if self._source.group:
                # Others on this machine may listen to the group too.
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                listener.bind(("", self._source.port))
                member = socket.inet_aton(self._source.group) + socket.inet_aton(self._source.interface)
                listener.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            else:
                listener.bind((self._source.interface, self._source.port))
            listener.setblocking(False)
        except OSError as error:
            listener.close()
            raise LostDevice(self.name, one_line(error)) from error
        self._socket = listener

    def read(self, timeout: float) -> list[Raw]:
        """What has come, waiting at most `timeout` s for the first datagram."""
        if self._socket is None:
            raise LostDevice(self.name, "it is not open")
        chunks: list[Raw] = []
        try:
            if not select.select([self._socket], [], [], timeout)[0]:
                return []
            self._turn()
            while True:
                data = self._socket.recv(LONGEST)
                chunks.append(SerialChunk(self._clock(), data))
        except BlockingIOError:
            return chunks
        except OSError as error:
            raise LostDevice(self.name, one_line(error)) from error

    def close(self) -> None:
        """Stop listening."""
        listener, self._socket = self._socket, None
        if listener is not None:
            listener.close()
