"""A serial port through pyserial: whatever bytes have come, in as few calls as can be."""

from __future__ import annotations

import os
import select
from pathlib import Path

import serial

from sms_adapters.raw import Clock, LostDevice, Raw, SerialChunk, Turn, at_once, one_line
from sms_online.description.sources import SerialPort
from sms_online.errors import InputError

# Most bytes of one read, which bounds what a flooded port can keep in memory: a second at 10 Mbit/s.
MOST_BYTES_READ = 1 << 20
EXPECTED = "a serial port, or a URL of one, that pyserial can open here"


class SerialReader:
    """Bytes of a serial port, or of a URL that pyserial knows: a `Reader`; after opening it begins with a break."""

    def __init__(self, source: SerialPort, clock: Clock, turn: Turn = at_once) -> None:
        self.name = source.name
        self._source = source
        self._clock = clock
        self._turn = turn
        self._port: serial.Serial | None = None
        self._opened = False  # and nothing read yet

    def open(self) -> None:
        """Open the port; raises LostDevice where that fails, InputError where it always will."""
        self.close()
        path = Path(self._source.port)
        if path.exists() and not path.is_char_device():
            raise InputError(self.name, self._source.port, "no device", EXPECTED)
        try:
            # Exclusive, for two readers of one port would each get half of the bytes.
            self._port = serial.serial_for_url(self._source.port, self._source.baudrate, exclusive=True)
            self._opened = True
        # A URL or a rate that pyserial does not know.
        except ValueError as error:
            raise InputError(self.name, self._source.port, one_line(error), EXPECTED) from error
        except OSError as error:
            raise LostDevice(self.name, one_line(error)) from error

    def read(self, timeout: float) -> list[Raw]:
        """What has come as one chunk, waiting at most `timeout` s for its first byte."""
        if self._port is None:
            raise LostDevice(self.name, "it is not open")
        try:
            data = self._bytes(self._port, timeout)
        # Unplugged, pyserial raises SerialException from read, but a bare OSError from in_waiting and, where the
        # descriptor is gone already, a TypeError.
        except (OSError, TypeError) as error:
            raise LostDevice(self.name, one_line(error)) from error
        if not data:
            return []
        arrival = self._clock()
        chunks: list[Raw] = [SerialChunk(arrival, b""), SerialChunk(arrival, data)]
        opened, self._opened = self._opened, False
        return chunks if opened else chunks[1:]

    def _bytes(self, port: serial.Serial, timeout: float) -> bytes:
        """What has come, waiting at most `timeout` s for its first byte."""
        if os.name == "posix" and type(port) is serial.Serial:
            # At every system call another thread may take the interpreter for a millisecond: two will do, pyserial
            # makes five.
            if not select.select([port.fileno()], [], [], timeout)[0]:
                return b""
            self._turn()
            try:
                data = os.read(port.fileno(), MOST_BYTES_READ)
            except BlockingIOError:
                return b""
            if not data:
                raise serial.SerialException("ready to be read, but nothing comes: gone, or somebody else reads it")
            return data
        if timeout != port.timeout:  # setting it is a system call
            port.timeout = timeout
        first: bytes = port.read(1)
        self._turn()
        # The rest in one call; what came with the first byte is there by now.
        if first and (waiting := port.in_waiting):
            return first + bytes(port.read(min(waiting, MOST_BYTES_READ)))
        return first

    def close(self) -> None:
        """Release the port."""
        port, self._port = self._port, None
        if port is not None:
            try:
                port.close()
            except OSError:
                return
