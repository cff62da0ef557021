"""The simulated arm as a process of its own, `python -m sms_sim.bus`: it moves in real time and speaks the frames of a
described testbed, on the CAN interface and the serial ports that the system file names; all but the copper is real.

A serial port is made as a pseudo-terminal with a link at the described path. Every device has an offset, drift, jitter
and latency of its own clock and transport.
"""

from __future__ import annotations

import argparse
import contextlib
import heapq
import os
import sys
import threading
import time
import tty
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np

from sms_adapters.can_decoder import CanDecoder
from sms_adapters.can_reader import CanReader, open_bus
from sms_adapters.can_signals import wanted_messages
from sms_adapters.capture import CaptureReader
from sms_adapters.part import Part
from sms_adapters.raw import EXTENDED, CanFrames, LostDevice
from sms_adapters.system_file import load_system
from sms_online.description.channels import drive_channels
from sms_online.description.schema import System
from sms_online.description.sources import CanBus, CanSource, SerialPort, Signal
from sms_online.errors import InputError
from sms_online.stream import Array, Block
from sms_sim.bus_encode import CanDevice, DeviceClock, SerialDevice, devices
from sms_sim.bus_layout import commands
from sms_sim.bus_motion import HeldTorque, MovingArm
from sms_sim.bus_solver import Solver

# The motion is solved at most so far ahead of what is sent, s.
AHEAD = 30.0
# The arm sets out once its motion is solved so far ahead that solving stays in front of sending to the end, where
# sending slows it down by this much; FIRST_LEAD, s, is enough to measure its pace by.
FIRST_LEAD = 0.5
SLOWED = 3.0
# What a port's driver keeps of what is sent faster than it is read, bytes, beside the few kB of a pseudo-terminal.
PORT_BUFFER = 16384
# Where the process that solves has less than this share of a core, others need the host too, and nobody knows how much
# it will have later: all that may be is then solved before the arm sets out.
QUIET = 0.8
# Longest wait between two looks at what is due, s.
PATIENCE = 0.05
# Torque commands are fetched so often, s.
COMMANDED = 4e-3


@dataclass(frozen=True)
class Transport:
    """Delays from a sample's instant to its sending: latency + uniform jitter, s. Order is kept within a source."""

    latency: float
    jitter: float


def sent_at(t: Array, transport: Transport, random: np.random.Generator, not_before: float) -> Array:
    """Instants (M,) at which samples of instants t (M,) are sent; not_before: when the one before them was."""
    delayed = t + transport.latency + random.uniform(0.0, transport.jitter, t.size)
    return np.maximum.accumulate(np.concatenate(([not_before], delayed)))[1:]


class CanSender:
    """Sends a CAN device's frames."""

    def __init__(self, device: CanDevice, source: CanBus) -> None:
        self._device = device
        self._bus = open_bus(source)

    def payloads(self, block: Block) -> list[tuple[Array, list[Any]]]:
        """Instants and frames of a block, for each sender on the bus."""
        return [(t, _as_messages(frames)) for t, frames in self._device.encode(block)]

    def send(self, message: can.Message) -> None:
        """Send a frame; a full queue of the kernel loses it, as a real bus does."""
        with contextlib.suppress(can.CanOperationError):
            self._bus.send(message)

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()


class CommandListener:
    """Sets an arm's torque to what comes on its CAN bus, from commands as `bus_layout` describes them."""

    def __init__(self, system: System, directory: Path | None, held: HeldTorque) -> None:
        source = next((source for source in system.sources if isinstance(source, CanSource)), None)
        if source is None:
            raise InputError(system.name, "source", "no CAN bus to take commands from", "a source of kind can")
        drives = drive_channels(system)
        signals = {name: Signal(channel=channel) for name, channel in commands(list(drives)).items()}
        described = source.model_copy(update={"signals": signals, "counters": ()})
        self._decoder = CanDecoder(wanted_messages(described, directory), tuple(signals.values()))
        self._joints = [drives[signal.channel] - 1 for signal in signals.values()]
        # A command is the torque at the motor shaft, before the gear.
        self._gears = np.array([joint.gear_ratio for joint in system.joints])
        self._gears[[i - 1 for drive, i in drives.items() if not drive.startswith("tau_")]] = 1.0
        self._reader = CanReader(source, time.monotonic, COMMANDED)
        self._reader.open()
        self._held = held
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            for item in self._reader.read(PATIENCE):
                for row in self._decoder.push(item).values:
                    torque = self._held.torque.copy()
                    given = ~np.isnan(row)
                    joints = np.array(self._joints)[given]
                    torque[joints] = row[given] * self._gears[joints]
                    self._held.torque = torque


class SerialSender:
    """Makes a pseudo-terminal, links it at the port's path, and sends a serial device's frames."""

    def __init__(self, device: SerialDevice, source: SerialPort) -> None:
        self._device = device
        self._path = Path(source.port)
        if self._path.exists() and not self._path.is_symlink():
            raise InputError(f"source {source.name}", "port", f"{source.port}, which exists", "a path for a new link")
        self._descriptor, self._other = os.openpty()
        tty.setraw(self._other)  # nothing but bytes; held open, so that a reader may come and go
        os.set_blocking(self._descriptor, False)
        self._path.unlink(missing_ok=True)
        self._path.symlink_to(os.ttyname(self._other))
        self._unsent = b""

    def payloads(self, block: Block) -> list[tuple[Array, list[Any]]]:
        """Instants and frames of a block."""
        return [self._device.encode(block)]

    def send(self, data: bytes) -> None:
        """Send a frame; it is lost where nobody reads the port and its buffer is full."""
        if len(self._unsent) < PORT_BUFFER:
            self._unsent += data
        with contextlib.suppress(BlockingIOError):
            self._unsent = self._unsent[os.write(self._descriptor, self._unsent) :]

    def close(self) -> None:
        """Unplug."""
        self._path.unlink(missing_ok=True)
        os.close(self._descriptor)
        os.close(self._other)


def _as_messages(frames: CanFrames) -> list[can.Message]:
    return [
        can.Message(arbitration_id=id_ & ~EXTENDED, is_extended_id=bool(id_ & EXTENDED), data=data[:length].tobytes())
        for id_, length, data in zip(frames.id.tolist(), frames.length.tolist(), frames.data, strict=True)
    ]


class Bus:
    """Senders of a system's sources, and what is still to be sent.

    directory: where the system file lies. clocks, transport: of the sources. seed: of the jitter. Raises InputError
    and LostDevice where a source cannot be made.
    """

    def __init__(
        self, system: System, directory: Path | None, clock: DeviceClock, transport: Transport, seed: int
    ) -> None:
        self._senders: list[CanSender | SerialSender] = []
        self._transport = transport
        self._random = np.random.default_rng(seed)
        # Heap of (instant, number, sender, payload): the number keeps what is due at once in order.
        self._queue: list[tuple[float, int, CanSender | SerialSender, Any]] = []
        self._number = 0
        self._last: dict[tuple[CanSender | SerialSender, int], float] = {}
        self._moving = threading.Condition()
        self._ended = False
        self._solved = 0.0  # s of motion that are in the queue, or through it
        self._full = False  # whether it ever held as much as it may
        self._ahead = 0.0
        can_devices, serial_devices = devices(system, directory, [clock] * len(system.sources))
        by_name = {source.name: source for source in system.sources}
        try:
            for device in can_devices:
                source = by_name[device.name]
                assert isinstance(source, CanBus)
                self._senders.append(CanSender(device, source))
            for port in serial_devices:
                source = by_name[port.name]
                assert isinstance(source, SerialPort)
                self._senders.append(SerialSender(port, source))
        except BaseException:
            self.close()
            raise

    def take(self, blocks: Iterable[Block], ahead: float = AHEAD) -> None:
        """Begin to take the blocks' samples, before they are due.

        ahead: by how much, s; 0 where the arm has to obey in time.
        """
        self._ahead = ahead
        threading.Thread(target=self._fill, args=(blocks, ahead), daemon=True).start()

    def await_taken(self) -> None:
        """Wait until samples have been taken as far ahead as they may be."""
        while not (self._ended or self._full or self._solved >= self._ahead):
            time.sleep(PATIENCE)

    def run(self, duration: float, solver: Solver | None = None) -> None:
        """Send the samples taken, `duration` s of them, in step with the clock. solver: whom they come from."""
        start: float | None = None
        if solver is not None:
            began = time.monotonic()
            while not (self._ended or self._full or self._far_enough(time.monotonic() - began, duration, solver.share)):
                time.sleep(PATIENCE)
            solver.give_way()
        while True:
            with self._moving:
                while not self._queue and not self._ended:
                    self._moving.wait(PATIENCE)
                if not self._queue:
                    return
                due, _, sender, payload = self._queue[0]
            if start is None:
                start = time.monotonic() - due
            wait = start + due - time.monotonic()
            # Not a microsecond early: who reads the bus takes the least delayed of its samples for undelayed.
            if wait > 0.0:
                time.sleep(min(wait, PATIENCE))
                continue
            with self._moving:
                heapq.heappop(self._queue)
                self._moving.notify()
            sender.send(payload)

    def _far_enough(self, elapsed: float, duration: float, share: float) -> bool:
        """Whether what is still to be solved will be in time, at the pace since the beginning, `elapsed` s ago.

        share: of a core that solving had meanwhile.
        """
        if self._solved < FIRST_LEAD or share < QUIET:
            return False
        return self._solved >= AHEAD or SLOWED * (duration - self._solved) * elapsed / self._solved < duration

    def _fill(self, blocks: Iterable[Block], ahead: float) -> None:
        """Keep the queue filled `ahead` of what is being sent."""
        try:
            for block in blocks:
                with self._moving:
                    while self._queue and float(block.t[0]) - self._queue[0][0] > ahead:
                        self._full = True
                        self._moving.wait(PATIENCE)
                for sender in self._senders:
                    for k, (t, payloads) in enumerate(sender.payloads(block)):
                        self._enqueue(sender, k, t, payloads)
                self._solved = float(block.t[-1])
        finally:
            with self._moving:
                self._ended = True
                self._moving.notify()

    def _enqueue(self, sender: CanSender | SerialSender, k: int, t: Array, payloads: Sequence[Any]) -> None:
        """Queue what the k-th node of a sender sends of samples at t."""
        before = self._last.get((sender, k), -np.inf)
        at = sent_at(t, self._transport, self._random, before)
        self._last[sender, k] = float(at[-1]) if at.size else before
        with self._moving:
            for due, payload in zip(at.tolist(), payloads, strict=True):
                heapq.heappush(self._queue, (due, self._number, sender, payload))
                self._number += 1
            self._moving.notify()

    def close(self) -> None:
        """Leave all buses."""
        for sender in self._senders:
            sender.close()


def capture_blocks(path: Path, duration: float, rows: int = 64) -> Iterator[Block]:
    """A capture's samples up to `duration` s, a few at a time, from t = 0."""
    first: float | None = None
    for block in Part(CaptureReader(path), str(path), None, duration):
        first = float(block.t[0]) if first is None else first
        yield from Block(block.t - first, block.channels, block.values).pieces(rows)


def main(arguments: list[str] | None = None) -> int:
    """Run the arm until its motion ends."""
    args = _parser().parse_args(arguments)
    solver: Solver | None = None
    try:
        system = load_system(args.system)
        path = Path(args.system)
        blocks: Iterable[Block]
        duration = args.duration or (system.trajectory.duration if system.trajectory is not None else np.inf)
        if args.capture is not None:
            blocks = capture_blocks(args.capture, duration)
        elif args.commanded:
            held = HeldTorque(len(system.joints))
            blocks = MovingArm(system, duration, args.grade, args.seed, held)
        else:
            blocks = solver = Solver(MovingArm(system, duration, args.grade, args.seed))
        clock = DeviceClock(args.offset, args.drift)
        transport = Transport(args.latency, args.jitter)
        folder = path.parent if path.suffix == ".toml" else None
        bus = Bus(system, folder, clock, transport, args.seed)
        if args.commanded:
            CommandListener(system, folder, held)
    except (InputError, LostDevice) as error:
        print(f"sms_sim.bus: {error}", file=sys.stderr)
        return 2
    try:
        if args.capture is not None:
            # This process reads it, and could not send in time beside that.
            bus.take(blocks)
            bus.await_taken()
        if args.wait:
            print("ready", flush=True)
            sys.stdin.readline()
        if args.capture is None:
            bus.take(blocks, ahead=0.0 if args.commanded else AHEAD)
        bus.run(duration, solver)
        if args.wait:
            # Devices whose arm rests are there still.
            print("done", flush=True)
            sys.stdin.readline()
    except KeyboardInterrupt:
        return 130
    finally:
        bus.close()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sms_sim.bus", description="A simulated testbed on its buses.")
    parser.add_argument("--system", required=True, help="a system file with [[source]] tables, or a shipped system")
    parser.add_argument("--capture", type=Path, help="play this capture instead of simulating the motion")
    parser.add_argument(
        "--commanded", action="store_true", help="obey torque commands on the CAN bus, not a controller"
    )
    parser.add_argument("--duration", type=float, help="s, the trajectory's by default")
    parser.add_argument("--grade", choices=("0", "A", "B", "C"), help="noise in place of the described sensors")
    parser.add_argument("--seed", type=int, default=0, help="of noise and jitter")
    parser.add_argument("--offset", type=float, default=0.0, help="of the serial devices' clocks, s")
    parser.add_argument("--drift", type=float, default=0.0, help="of the serial devices' clocks, relative")
    parser.add_argument("--latency", type=float, default=0.0, help="constant delay of the transport, s")
    parser.add_argument("--jitter", type=float, default=0.0, help="uniform delay from 0 to this, s")
    parser.add_argument(
        "--wait",
        action="store_true",
        help="say ready, move once a line comes on stdin, say done and stay until another comes",
    )
    return parser


if __name__ == "__main__":
    sys.setswitchinterval(5e-4)  # the sender must not wait for the solver
    sys.exit(main())
