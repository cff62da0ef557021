"""A simulated testbed that delivers its samples as it moves."""

from __future__ import annotations

from collections.abc import Iterator

from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.stream import Block
from sms_sim.integrate import STAGES, Dense, Step, dense, march
from sms_sim.plant import Plant
from sms_sim.sensors import Sensors
from sms_sim.simulate import LONGEST_STEP, read_blocks, tolerance

# Motion in a block, s: ten a second look continuous.
BLOCK_SECONDS = 0.1


class LivePlant:
    """A described system in closed loop from rest, integrated while it is read: a `Source`.

    duration: s. grade, seed: of the noise, see `Sensors`. Raises InputError where the system has no controller or
    trajectory to move it, or where the motion cannot be followed.
    """

    def __init__(self, system: System, grade: str | None, seed: int) -> None:
        if system.controller is None or system.trajectory is None:
            missing = "controller" if system.controller is None else "trajectory"
            raise InputError(system.name, missing, "no such table", "a controller and a trajectory to move the arm")
        self.duration = system.trajectory.duration
        self._plant = Plant(system)
        self._sensors = Sensors(system, self._plant.channels, grade, seed)
        self.channels = self._sensors.channels
        self.warnings: list[str] = []

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks from the start of the motion; noise goes on from where an earlier iteration left it."""
        plant, sensors = self._plant, self._sensors
        at_once = max(1, round(BLOCK_SECONDS * plant.system.sample_rate))
        steps = march(plant.rate, plant.rest, self.duration, tolerance(plant), longest=LONGEST_STEP)
        # The steps that samples may still be taken from, and the state before them.
        before, start, kept = 0.0, plant.rest, list[Step]()
        reach = float(sensors.latency.max()) + BLOCK_SECONDS

        def until(t: float) -> Dense:
            nonlocal before, start
            while not kept or kept[-1].t < t:
                kept.append(next(steps))
            while kept[0].t < t - reach:
                before, start = kept[0].t, kept[0].y
                del kept[0]
            return dense(STAGES, before, start, kept)

        try:
            yield from read_blocks(plant, sensors, self.duration, until, at_once)
        except ArithmeticError as error:
            raise InputError(plant.system.name, "trajectory", str(error), "a motion that can be followed") from None
