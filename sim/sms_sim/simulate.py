"""A simulated session: the exact motion of a testbed, its drift, and what its sensors record."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.stream import Array, Block
from sms_online.threads import one_blas_thread
from sms_sim.distortion import Distortion
from sms_sim.drifting import ParameterDrift
from sms_sim.integrate import Dense, solve
from sms_sim.plant import Plant
from sms_sim.sensors import Sensors

# Bounds of the local error of a step. Positions are going to be differentiated: with these bounds an eighth-order
# difference of them at 1 kHz is within 3e-9 m/s or rad/s of the speeds (measured on the planar example).
POSITION_TOLERANCE = 1e-11  # m, rad
# Longest step, s. Rounding of the stages grows with what changes in a step, and samples between its ends are going to
# be differentiated: at 0.2 s their rates are off by 5e-10 rad/s, here by a twentieth of that.
LONGEST_STEP = 0.01
# Speeds change that much faster than positions, 1/s.
SPEED_FACTOR = 100.0
# Samples of a block: enough to hide the cost of a call.
BLOCK_SAMPLES = 1000


@dataclass(frozen=True)
class Drift:
    """What the integrator lost, as the largest deviation over the session.

    energy: of motor work - K - U - E_diss, relative to the largest energy (above that at rest). linear_momentum,
    angular_momentum: of the whole system about the inertial origin, relative to what base and arm exchange; None where
    momentum is not conserved (a fixed base, gravity, effects on the base).
    """

    energy: float
    linear_momentum: float | None
    angular_momentum: float | None


@dataclass(frozen=True)
class ExactStates:
    """Exact values at B instants.

    t (B,) s; x (B, n_x), v (B, n_v) in the order of the model's layout; torque (B, inputs): see `Plant.torque`; work
    (B, joints): of each motor since the start, (42), J; dissipated (B,): since the start, (24), with what declared
    effects took out, J.
    """

    t: Array
    x: Array
    v: Array
    torque: Array
    work: Array
    dissipated: Array


@dataclass(frozen=True)
class Simulation:
    """The motion of a plant: solution holds its states at the integrator's steps and, as polynomials, between them."""

    plant: Plant
    solution: Dense

    @property
    def duration(self) -> float:
        """Length of the session, s."""
        return float(self.solution.t[-1])

    @cached_property
    def _powers(self) -> Array:
        """Power of each motor and dissipated power, W, at all stages: (M, s, joints + 1)."""
        plant, solution = self.plant, self.solution
        shape = solution.stages.shape
        t, y = solution.stage_times.ravel(), solution.stages.reshape(-1, shape[2])
        parts = []
        for start in range(0, t.size, BLOCK_SAMPLES):
            rows = slice(start, start + BLOCK_SAMPLES)
            inputs = plant.inputs(t[rows], y[rows])
            dissipated = plant.dynamics.dissipation_power(*plant.split(y[rows]), inputs)
            parts.append(np.column_stack((plant.motor_power(t[rows], y[rows]), dissipated)))
        return np.concatenate(parts).reshape(shape[0], shape[1], -1)

    @property
    def beyond(self) -> list[str]:
        """Where the motion goes beyond what effects are known for, a sentence each."""
        model = self.plant.model
        if not model.effects:
            return []
        exact = exact_states(self, self.solution.t)
        return [said for effect in model.effects if (said := effect.beyond(model.layout, exact.x, exact.v))]

    @cached_property
    def drift(self) -> Drift:
        """Energy and momentum that the integrator lost."""
        exact = exact_states(self, self.solution.t)
        x, v, dynamics = exact.x, exact.v, self.plant.dynamics
        energy = dynamics.energy(x, v)
        lost = exact.work.sum(axis=1) - exact.dissipated - (energy - energy[0])
        at_rest = dynamics.energy(*self.plant.split(self.plant.rest[None]))
        energy_drift = _ratio(lost, energy - at_rest)
        layout, system = self.plant.model.layout, self.plant.system
        pushed = any(effect.where == "base" for effect in self.plant.model.effects)
        if not layout.free or any(system.gravity) or pushed:
            return Drift(energy_drift, None, None)
        rows = dynamics.mass_matrix(x)[:, : layout.n_base_speeds]
        # (B, n_base, n_v): momentum conjugate to the base's speeds, about S, by the speed that it comes from.
        shares = rows * v[:, None, :]
        n = len(layout.base_linear)
        linear = shares[:, :n].sum(axis=2)
        r_S, p = np.zeros((2, x.shape[0], 3))
        r_S[:, list(layout.base_linear)] = x[:, :n]
        p[:, list(layout.base_linear)] = linear
        angular = shares[:, n:].sum(axis=2) + np.cross(r_S, p)[:, list(layout.base_angular)]
        return Drift(
            energy_drift,
            _ratio(linear - linear[0], np.abs(shares[:, :n]).sum(axis=2)),
            _ratio(angular - angular[0], np.abs(shares[:, n:]).sum(axis=2)),
        )


def _ratio(lost: Array, scale: Array) -> float:
    """Largest |lost| over largest |scale|; 0 where nothing moved."""
    largest = float(np.abs(scale).max())
    return float(np.abs(lost).max()) / largest if largest > 0.0 else 0.0


@one_blas_thread()
def simulate(
    system: System,
    duration: float | None = None,
    parameters: Array | None = None,
    initial: tuple[Array, Array] | None = None,
    position_tolerance: float = POSITION_TOLERANCE,
    progress: Callable[[float], None] = lambda share: None,
    drifts: Sequence[ParameterDrift] = (),
) -> Simulation:
    """Integrate a described system in closed loop, to `position_tolerance` (m, rad) a step.

    duration: s, the reference's own by default. parameters: π (n_pi,) in place of the nominal ones. initial: x (n_x,)
    and v (n_v,) in place of rest. progress: is called with the share that is solved, step by step. drifts: of
    parameters. Raises InputError where nothing states the duration, ArithmeticError where the motion cannot be
    followed.
    """
    if duration is None:
        if system.trajectory is None:
            raise InputError(system.name, "trajectory", "no such table", "a trajectory, or a duration in seconds")
        duration = system.trajectory.duration
    plant = Plant(system, parameters, drifts)
    start = plant.rest if initial is None else plant.state(*initial)
    bounds = tolerance(plant, position_tolerance)
    solution = solve(
        plant.rate, start, duration, bounds, longest=LONGEST_STEP, progress=lambda t: progress(t / duration)
    )
    return Simulation(plant, solution)


def tolerance(plant: Plant, position: float = POSITION_TOLERANCE) -> Array:
    """Bounds of the local error of each state, (n_y,); internal states of effects are positions and their rates."""
    layout = plant.model.layout
    speeds = layout.n_v + plant.model.n_states
    return np.concatenate((np.full(layout.n_x, position), np.full(speeds, SPEED_FACTOR * position)))


@one_blas_thread()
def exact_states(simulation: Simulation, t: Array) -> ExactStates:
    """Exact states, torques and energies at instants t (B,) within the session, s."""
    plant, solution = simulation.plant, simulation.solution
    y = solution(t)
    x, v = plant.split(y)
    energies = solution.integral(simulation._powers, t)
    return ExactStates(t, x, v, plant.torque(t, y), energies[:, :-1], energies[:, -1])


def sampled_blocks(simulation: Simulation, grade: str | None = None, seed: int = 0) -> Iterator[Block]:
    """What the sensors record at the system's rate, in blocks: drives, positions, and rates or strain described.

    grade: a noise grade (`sensors.GRADES`) in place of the described sensors. seed: of the noise. Raises InputError on
    an unknown grade.
    """
    plant, duration = simulation.plant, simulation.duration
    sensors = Sensors(plant.system, plant.recordable, grade, seed)
    rate = plant.system.sample_rate
    columns = [plant.recordable.index(channel) for channel in sensors.channels]
    # Half a sample of slack: duration times rate may fall short of a whole number by rounding.
    samples = int(duration * rate + 0.5) + 1

    distortion = Distortion(plant.system, sensors.channels)
    many = distortion.oversampling

    @one_blas_thread()
    def exact(t: Array) -> Array:
        """Exact values (B, C) at instants t (B,); before the start the system rests."""
        inside = np.clip(t, 0.0, duration)
        y = simulation.solution(inside)
        torque = np.where(t[:, None] < 0.0, 0.0, plant.torque(inside, y))
        x, v = plant.split(y)
        return np.concatenate((plant.channel_values(torque, x), plant.further_values(x, v)), axis=1)[:, columns]

    for first in range(0, samples, BLOCK_SAMPLES):
        end = min(first + BLOCK_SAMPLES, samples)
        fine = np.arange(max(0, many * (first - 1) + 1), many * (end - 1) + 1) / (many * rate)
        t = np.arange(first, end) / rate
        values = np.empty((fine.size, len(columns)))
        for latency in np.unique(sensors.latency):
            late = sensors.latency == latency
            values[:, late] = exact(fine - latency)[:, late]
        yield Block(t, sensors.channels, sensors.read(first, distortion(values)))
