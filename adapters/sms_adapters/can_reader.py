"""A CAN bus through python-can, whatever the interface: frames with the stamps of the hardware or the kernel."""

from __future__ import annotations

import errno
import os
import socket
import time
from collections.abc import Sequence
from dataclasses import replace

import can
import numpy as np

from sms_adapters.clock_merge import TICK
from sms_adapters.raw import (
    ERROR_FRAME,
    EXTENDED,
    FD_FRAME,
    MOST_BYTES,
    REMOTE_FRAME,
    CanFrames,
    Clock,
    LostDevice,
    Raw,
    Turn,
    at_once,
    one_line,
)
from sms_online.description.sources import CanBus
from sms_online.errors import InputError
from sms_online.stream import Array

# Where the host stamps frames they wait in the driver until so long before the session's next tick, s. Nobody else
# computes then, and at every frame another thread may take the interpreter for a millisecond. Reading takes half of it.
BEFORE_TICK = 4e-3
# Where nothing but the reading shows when a frame arrived, it must not wait so long, s.
PROMPT_INTERVAL = 1e-3
# Bytes that UDP multicast may hold back; the usual 212 kB overflow within a tenth of a second of a busy bus.
RECEIVE_BUFFER = 4 << 20
# Most frames of one read, which bounds what a flooded bus can keep in memory.
MOST_FRAMES = 4096
# Items in a row that an interface could not read, after which it counts as lost.
MOST_GARBLED = 100
# CAN_ERR_BUSOFF of linux/can/error.h, in the identifier of an error frame, on interfaces that speak as socketcan does.
BUS_OFF = 0x40
SOCKETCAN_FRAMES = ("socketcan", "udp_multicast", "virtual")
# Interfaces whose stamps are the host's own clock (UTC) when a frame arrived, and how long a frame may have waited for
# the reader, s, until its stamp is not believed: somebody may have set that clock.
HOST_STAMPED = SOCKETCAN_FRAMES
LONGEST_WAIT = 1.0
# Two clocks read within so long, s, are read at once: half of it is what they are apart; so often is it tried.
SAME_INSTANT = 1e-5
MOST_TRIES = 10


def open_bus(source: CanBus) -> can.BusABC:
    """The python-can bus of a source; LostDevice where it cannot be opened now, InputError where it never can."""
    options = source.options if source.bitrate is None else {"bitrate": source.bitrate} | source.options
    try:
        # The system file alone says what is opened, not a python-can configuration of the user's or the machine's.
        return can.Bus(source.channel, source.interface, ignore_config=True, **options)  # type: ignore[arg-type]
    # Interfaces raise what their drivers raise: OSError, ImportError of a missing driver, TypeError for a wrong option.
    except Exception as error:
        if _for_ever(error):
            place = f"{source.interface} {source.channel}"
            raise InputError(source.name, place, one_line(error), "a bus that python-can can open here") from error
        raise LostDevice(source.name, f"{source.interface} {source.channel}: {one_line(error)}") from error


def _for_ever(error: Exception) -> bool:
    """Whether no cable or switch can mend it: an interface, library or kernel that is not there, a wrong option."""
    if isinstance(error, OSError):
        # A missing library has no number.
        return error.errno == errno.EAFNOSUPPORT or (type(error) is OSError and error.errno is None)
    return isinstance(error, ImportError | NotImplementedError | TypeError | ValueError)


class CanReader:
    """Frames of a CAN bus: a `Reader`.

    What an interface received but could not make a frame of is delivered as an error frame, so that it is recorded and
    counted. Bus-off is a lost device: opening it again starts the controller again.

    period: s; frames that the host stamps are fetched so often, shortly before its multiples on the clock. turn: called
    before each fetch.
    """

    def __init__(self, source: CanBus, clock: Clock, period: float = TICK, turn: Turn = at_once) -> None:
        self.name = source.name
        self._source = source
        self._clock = clock
        self._period = period
        self._turn = turn
        self._bus: can.BusABC | None = None
        self._garbled = 0
        self._host_stamped = source.interface in HOST_STAMPED
        self._last_read = -np.inf
        self._last_arrival = -np.inf
        self._lost: LostDevice | None = None  # found while frames were at hand, to be raised after them

    def open(self) -> None:
        """Open the bus; raises LostDevice where that fails, InputError where it always will."""
        self.close()
        self._bus = open_bus(self._source)
        if self._source.interface == "udp_multicast":
            # A burst of frames must fit while the reader sleeps; the kernel grants what it allows.
            with socket.socket(fileno=os.dup(self._bus.fileno())) as receiver:
                receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        self._garbled, self._lost = 0, None

    def read(self, timeout: float) -> list[Raw]:
        """All frames that have come, at most MOST_FRAMES, waiting at most `timeout` s for the first."""
        if self._bus is None:
            raise LostDevice(self.name, "it is not open")
        if self._host_stamped:
            time.sleep(-(self._clock() + BEFORE_TICK) % self._period)
        else:
            time.sleep(max(0.0, PROMPT_INTERVAL - (time.monotonic() - self._last_read)))
        self._turn()
        messages: list[can.Message] = []
        arrivals: list[float] = []
        while self._lost is None and len(messages) < MOST_FRAMES:
            message = self._receive(self._bus, 0.0 if messages else timeout)
            if message is None:
                break
            messages.append(message)
            if not self._host_stamped:
                arrivals.append(self._clock())
        self._last_read = time.monotonic()
        if messages:
            if self._host_stamped:
                return [self._as_stamped(frames_of(messages, np.full(len(messages), self._clock())))]
            return [frames_of(messages, np.array(arrivals))]
        if self._lost is not None:
            raise self._lost
        return []

    def _as_stamped(self, frames: CanFrames) -> CanFrames:
        """The frames with arrivals by the host's stamps, which no waiting for this thread delays."""
        now, host = self._both_clocks()
        waited = host - frames.stamp
        believed = (waited >= 0.0) & (waited <= LONGEST_WAIT)
        arrival = np.where(believed, now - waited, frames.arrival)
        # In order, as they were received.
        arrival = np.maximum.accumulate(np.concatenate(([self._last_arrival], arrival)))[1:]
        self._last_arrival = float(arrival[-1])
        return replace(frames, arrival=arrival)

    def _both_clocks(self) -> tuple[float, float]:
        """The session's clock and the host's (UTC) at one instant, s.

        Between two readings another thread may take the interpreter for milliseconds. Frames would then be early by as
        much, which no bus makes them, and whoever looks for the least delayed ones would follow these.
        """
        nearest, pair = np.inf, (0.0, 0.0)
        for _ in range(MOST_TRIES):
            before, host, after = self._clock(), time.time(), self._clock()
            if after - before < nearest:
                nearest, pair = after - before, (0.5 * (before + after), host)
            if nearest <= SAME_INSTANT:
                break
        return pair

    def _receive(self, bus: can.BusABC, timeout: float) -> can.Message | None:
        """The next frame, None where there is none, or where the device turns out to be lost."""
        try:
            message = bus.recv(timeout)
        except can.CanError as error:
            if error.__cause__ is None or isinstance(error.__cause__, OSError):
                self._lost = LostDevice(self.name, one_line(error))
                return None
            return self._garble(bus, error)
        except OSError as error:
            self._lost = LostDevice(self.name, one_line(error))
            return None
        except (ValueError, IndexError) as error:
            return self._garble(bus, error)
        if message is None:
            return None
        self._garbled = 0
        if message.is_error_frame and message.arbitration_id & BUS_OFF and self._source.interface in SOCKETCAN_FRAMES:
            self._lost = LostDevice(self.name, "bus-off, too many errors on the bus")
        return message

    def _garble(self, bus: can.BusABC, error: Exception) -> can.Message:
        """An error frame in place of what could not be read."""
        self._garbled += 1
        if self._garbled > MOST_GARBLED:
            self._lost = LostDevice(self.name, f"nothing but garbage ({one_line(error)})")
        # slcan keeps bytes that are not text in its buffer and would trip over them for ever.
        if isinstance(error.__cause__ or error, UnicodeDecodeError) and hasattr(bus, "flush"):
            bus.flush()
        return can.Message(is_error_frame=True)

    def close(self) -> None:
        """Release the bus."""
        bus, self._bus = self._bus, None
        if bus is not None:
            try:
                bus.shutdown()
            # Of an adapter that is gone, drivers raise anything.
            except Exception:
                return


def frames_of(messages: Sequence[can.Message], arrival: Array) -> CanFrames:
    """python-can's messages as arrays; arrival: (N,) s."""
    stamp = np.array([message.timestamp for message in messages])
    stamp[stamp == 0.0] = np.nan  # what python-can gives where the interface has no stamp
    data = b"".join(bytes(message.data).ljust(MOST_BYTES, b"\0") for message in messages)
    flags = [
        message.is_error_frame * ERROR_FRAME | message.is_remote_frame * REMOTE_FRAME | message.is_fd * FD_FRAME
        for message in messages
    ]
    return CanFrames(
        arrival,
        stamp,
        np.array([m.arbitration_id | m.is_extended_id * EXTENDED for m in messages], dtype=np.uint32),
        # Of a line that lost some bytes, python-can reports the length that there should be.
        np.array([m.dlc if m.is_remote_frame else len(m.data) for m in messages], dtype=np.uint8),
        np.frombuffer(data, np.uint8).reshape(-1, MOST_BYTES),
        np.array(flags, dtype=np.uint8),
    )
