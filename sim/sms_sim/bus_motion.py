"""The moving arm of a simulated bus: samples as the sensors take them, a few milliseconds at a time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.stream import Array, Block, Indices
from sms_sim.distortion import Distortion
from sms_sim.plant import Plant
from sms_sim.realtime import STEP, STEPS_AT_ONCE, RealTimeStepper
from sms_sim.sensors import Sensors


class HeldTorque:
    """A controller outside the arm: each joint keeps the torque last commanded, n τ (joints,), N m (N)."""

    def __init__(self, joints: int) -> None:
        self.torque = np.zeros(joints)

    def __call__(self, t: Array, q: Array, q_dot: Array) -> Array:
        """The same torque at all instants t (B,): (B, joints)."""
        return np.broadcast_to(self.torque, (t.size, self.torque.size))


class MovingArm:
    """A described system that moves in steps of a millisecond, as a `Source` with blocks of eight steps.

    duration: s. grade, seed: of the noise, see `Sensors`. commanded: takes its torque instead of the system's
    controller. Raises InputError where nothing moves the arm, or where its samples do not fall on the steps; while
    iterating where the motion is too fast for them.
    """

    def __init__(
        self, system: System, duration: float, grade: str | None, seed: int, commanded: HeldTorque | None = None
    ) -> None:
        self._plant = Plant(system)
        if commanded is not None:
            self._plant.controller = commanded  # type: ignore[assignment]  # anything that gives torques will do
        elif self._plant.controller is None:
            missing = "controller" if system.controller is None else "trajectory"
            raise InputError(system.name, missing, "no such table", "a controller and a trajectory to move the arm")
        self._every = round(1.0 / (system.sample_rate * STEP))
        if abs(self._every * STEP * system.sample_rate - 1.0) > 1e-9:
            found = f"{system.sample_rate:g} Hz"
            raise InputError(system.name, "sample_rate", found, f"1000 Hz divided by a whole number, {STEP:g} s a step")
        self._sensors = Sensors(system, self._plant.channels, grade, seed)
        self.channels = self._sensors.channels
        self.duration = duration
        self.warnings: list[str] = []

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks from rest, t = 0 first."""
        plant, sensors = self._plant, self._sensors
        self._distortion = Distortion(plant.system, sensors.channels, single=True)
        columns = [plant.channels.index(channel) for channel in self.channels]
        rate = plant.system.sample_rate
        samples = int(self.duration * rate + 0.5) + 1
        x, _ = plant.split(plant.rest[None])
        # Before the start the arm rests; the first rows are what the most delayed sensor still shows then.
        delays = np.rint(sensors.latency * rate).astype(np.int64)
        # Where commands act later than they are read everything else comes late: nobody knows the torque of tomorrow.
        delays -= min(0, delays.min(initial=0))
        longest = int(delays.max(initial=0))
        rest = plant.channel_values(np.zeros((1, plant.model.n_inputs)), x)[:, columns]
        history = np.repeat(rest, longest + 1, axis=0)
        history[-1] = plant.channel_values(plant.torque(np.zeros(1), plant.rest[None]), x)[:, columns]
        yield self._block(0, history, delays, 1)
        stepper = RealTimeStepper(plant)
        first = 1
        while first < samples:
            fresh = self._exact(stepper, columns)[: samples - first]
            history = np.concatenate((history[history.shape[0] - longest :], fresh))
            yield self._block(first, history, delays, fresh.shape[0])
            first += fresh.shape[0]

    def _exact(self, stepper: RealTimeStepper, columns: list[int]) -> Array:
        """Exact values (B, C) at the samples of the next steps."""
        try:
            states = [stepper.step() for _ in range(STEPS_AT_ONCE * self._every)][self._every - 1 :: self._every]
        except ArithmeticError as error:
            raise InputError(
                self._plant.system.name, "trajectory", str(error), "a motion that can be followed"
            ) from None
        torque = np.stack([state.torque for state in states])
        return self._plant.channel_values(torque, np.stack([state.x for state in states]))[:, columns]

    def _block(self, first: int, history: Array, delays: Indices, count: int) -> Block:
        """The readings of `count` samples from `first` on; exact values up to the last of them end history (K, C)."""
        rows = np.arange(history.shape[0] - count, history.shape[0])
        late = np.take_along_axis(history, rows[:, None] - delays, axis=0)
        t = np.arange(first, first + count) / self._plant.system.sample_rate
        return Block(t, self.channels, self._sensors.read(first, self._distortion(late)))
