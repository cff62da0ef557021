"""A simulated testbed that delivers its samples as it moves."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.stream import Block
from sms_sim.plant import Plant
from sms_sim.realtime import STEP, RealTimeStepper, Sample
from sms_sim.sensors import Sensors

# Motion in a block, s.
BLOCK_SECONDS = 0.1


class LivePlant:
    """A described system in closed loop from rest, solved while it is read: a `Source`.

    duration: s. grade, seed: of the noise, see `Sensors`. Latencies act to the nearest STEP. Raises InputError where
    the system has no controller or trajectory to move it, where steps do not fall on its sample rate, or where the
    motion cannot be followed in steps of STEP.
    """

    def __init__(self, system: System, grade: str | None, seed: int) -> None:
        if system.controller is None or system.trajectory is None:
            missing = "controller" if system.controller is None else "trajectory"
            raise InputError(system.name, missing, "no such table", "a controller and a trajectory to move the arm")
        stride = 1.0 / (STEP * system.sample_rate)
        self._stride = round(stride)
        if abs(stride - self._stride) > 1e-9 * stride:
            expected = f"{1.0 / STEP:g} Hz divided by a whole number, for the simulation steps at that rate"
            raise InputError(system.name, "sample_rate", f"{system.sample_rate:g} Hz", expected)
        self.duration = system.trajectory.duration
        self._plant = Plant(system)
        self._sensors = Sensors(system, self._plant.channels, grade, seed)
        self.channels = self._sensors.channels
        self.warnings: list[str] = []

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks from the start of the motion; noise goes on from where an earlier iteration left it."""
        plant, sensors = self._plant, self._sensors
        stepper = RealTimeStepper(plant)
        columns = [plant.channels.index(channel) for channel in self.channels]
        delay = np.rint(sensors.latency / STEP).astype(int)
        start, rest = np.zeros(1), plant.rest[None]
        before = plant.channel_values(0.0 * plant.torque(start, rest), plant.split(rest)[0])[:, columns]
        first = plant.channel_values(plant.torque(start, rest), plant.split(rest)[0])[:, columns]
        # Exact values at every step, as far back as the longest latency reaches.
        history = np.concatenate((np.repeat(before, delay.max(), axis=0), first))
        samples = int(self.duration * plant.system.sample_rate + 0.5) + 1
        at_once = max(1, round(BLOCK_SECONDS * plant.system.sample_rate))
        done = 0
        while done < samples:
            count = min(at_once, samples - done)
            # The first sample of all is the instant 0, which is there already.
            steps = self._advance(stepper, self._stride * (count - (done == 0)))
            if steps:
                x, torque = np.array([step.x for step in steps]), np.array([step.torque for step in steps])
                history = np.concatenate((history, plant.channel_values(torque, x)[:, columns]))
            ends = history.shape[0] - 1 - self._stride * np.arange(count - 1, -1, -1)
            exact = history[ends[:, None] - delay, np.arange(len(columns))]
            t = np.arange(done, done + count) / plant.system.sample_rate
            yield Block(t, self.channels, sensors.read(done, exact))
            history = history[history.shape[0] - max(1, delay.max()) :]
            done += count

    def _advance(self, stepper: RealTimeStepper, steps: int) -> list[Sample]:
        try:
            return [stepper.step() for _ in range(steps)]
        except ArithmeticError as error:
            expected = f"a motion that steps of {STEP} s can follow"
            raise InputError(self._plant.system.name, "trajectory", str(error), expected) from None
