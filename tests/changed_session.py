"""Sessions in which something changes: a motion that goes on, from where it is, with another system."""

from __future__ import annotations

import numpy as np

from sms_online.description.schema import System
from sms_online.stream import Array, Block
from sms_sim.integrate import solve
from sms_sim.plant import Plant
from sms_sim.sensors import Sensors
from sms_sim.simulate import LONGEST_STEP, Simulation, exact_states, tolerance


class LaterController:
    """A controller whose clock began `elapsed` seconds before the simulation."""

    def __init__(self, plant: Plant, elapsed: float) -> None:
        assert plant.controller is not None
        self._controller, self._elapsed = plant.controller, elapsed

    def __call__(self, t: Array, q: Array, q_dot: Array) -> Array:
        """Torque (B, joints) at instants t (B,) of the simulation."""
        return self._controller(t + self._elapsed, q, q_dot)


def changed_session(
    before: Simulation, after: System, change: float, duration: float, back: float | None = None
) -> Block:
    """Exact samples of `before` up to `change` (s), then of the system `after` up to `duration` (s).

    From `back` (s) on they are of the first system again. Positions and speeds are continuous: what is grasped moves
    with the tip already. Internal states begin at rest.
    """
    rate = after.sample_rate
    parts = [exact_states(before, np.arange(round(change * rate) + 1) / rate)]
    later = [(after, change), *([] if back is None else [(before.plant.system, back)])]
    for (system, begin), end in zip(later, [each for _, each in later[1:]] + [duration], strict=True):
        plant = Plant(system)
        plant.controller = LaterController(plant, begin)  # type: ignore[assignment]
        state = plant.state(parts[-1].x[-1], parts[-1].v[-1])
        solution = solve(plant.rate, state, end - begin, tolerance(plant), longest=LONGEST_STEP)
        steps = round((end - begin) * rate)
        parts.append(exact_states(Simulation(plant, solution), np.arange(1, steps + 1) / rate))
    x, torque = (np.concatenate([getattr(part, name) for part in parts]) for name in ("x", "torque"))
    return Block(np.arange(len(x)) / rate, plant.channels, plant.channel_values(torque, x))


def noisy(system: System, exact: Block, grade: str | None, seed: int) -> Block:
    """The samples with a grade's sensor noise, or the described one."""
    sensors = Sensors(system, exact.channels, grade, seed)
    return Block(exact.t, exact.channels, sensors.read(0, exact.values))
