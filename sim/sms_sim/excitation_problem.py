"""What a designed motion is judged by: bounds of parameters and loads of limits, for Fourier series of every joint."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from sms_online.cramer_rao import cramer_rao_bound
from sms_online.description.schema import Harmonic, System, Trajectory
from sms_online.errors import InputError
from sms_online.linearised import Motion
from sms_online.model.base_parameters import find_base_parameters
from sms_online.stream import Array
from sms_sim.bound import motion_bounds, noisy_sensors
from sms_sim.capture import Simulated
from sms_sim.ensemble import ensemble
from sms_sim.motion_limits import Extremes, Limits
from sms_sim.plant import Plant
from sms_sim.simulate import Simulation, exact_states

# Frequencies of a series at least, and of those drawn beside described ones: four octaves above the slowest, for a
# link's modes lie far above what joints follow.
FREQUENCIES, LEAST_DRAWN, OCTAVES = 5, 2, 4.0
# Periods of the slowest in a motion without a described one: several, of which each repeats what the others show.
PERIODS = 5
# Step of the motions that are compared and of their bounds, s. The planar example's worst bound then comes out to 1e-4;
# with twice the step it is a tenth low, and a search finds motions for which it is a third low.
STEP = 0.01
# Longest motion, s: all that are compared are in memory at once.
LONGEST = 600.0


class Series:
    """Fourier series of every joint over common frequencies (K,), rad/s; a point is all sines and cosines, rad (m)."""

    def __init__(self, frequency: Array, joints: int) -> None:
        self.frequency, self._joints = frequency, joints
        self.size = 2 * frequency.size * joints

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Sines and cosines (P, K, joints) of points (P, size)."""
        parts = points.reshape(-1, 2, self.frequency.size, self._joints)
        return parts[:, 0], parts[:, 1]

    def drawn(self, random: np.random.Generator, count: int, largest: float) -> Array:
        """Random points (count, size), of alike rates at all frequencies, that reach `largest`, rad (m), at most."""
        points = (random.normal(size=(count, 2, self.frequency.size, self._joints)) / self.frequency[:, None]).reshape(
            count, self.size
        )
        most = sum(np.abs(part).sum(axis=1) for part in self(points))  # (count, joints)
        return np.asarray(points * (largest / most.max(axis=1))[:, None])

    def nearest(self, trajectory: Trajectory) -> Array:
        """Point (size,) of a described series, whose frequencies are among these."""
        parts = np.zeros((2, self.frequency.size, self._joints))
        for j, terms in enumerate(trajectory.joints):
            for term in terms:
                at = np.isclose(self.frequency, term.frequency)
                parts[:, at, j] += np.array([[term.sine], [term.cosine]])
        return parts.ravel()

    def trajectory(self, point: Array, duration: float) -> Trajectory:
        """The series as it is described."""
        sine, cosine = (part[0] for part in self(point[None]))
        joints = tuple(
            tuple(
                Harmonic(frequency=float(w), sine=float(sine[k, j]), cosine=float(cosine[k, j]))
                for k, w in enumerate(self.frequency)
            )
            for j in range(self._joints)
        )
        return Trajectory(duration=duration, joints=joints)


def _frequencies(stated: Sequence[float], random: np.random.Generator) -> Array:
    """The stated frequencies and others, each drawn from its own part of the octaves above the slowest, rad/s."""
    own = np.unique(stated)
    count = max(FREQUENCIES - own.size, LEAST_DRAWN)
    # A step of more than a radian of a harmonic shows neither its bounds nor its loads.
    ratio = max(1.0, min(2.0**OCTAVES, 1.0 / (STEP * own[0])))
    return np.union1d(own, own[0] * ratio ** ((np.arange(count) + random.uniform(size=count)) / count))


class Problem:
    """Criterion and loads of series. bounds (signals,): largest magnitudes; counted (n,): parameters that matter."""

    def __init__(
        self,
        system: System,
        duration: float,
        grade: str | None,
        limits: Limits,
        described: Simulation | None,
        frequency: Array,
        counted: Callable[[str, float], bool],
    ) -> None:
        self.system, self.duration = system, duration
        self.plant = Plant(system)
        self.sensors, self.grade = noisy_sensors(self.plant, grade)
        self.extremes, self.base = Extremes(self.plant), find_base_parameters(self.plant.model)
        values = np.abs(self.base.values(self.plant.parameters))
        names = [p.name for p in self.base.parameters]
        self.counted = np.array([counted(name, value) for name, value in zip(names, values, strict=True)], dtype=bool)
        if zero := [name for name, c, value in zip(names, self.counted, values, strict=True) if c and value == 0.0]:
            raise InputError(system.name, zero[0], "nominally zero", "its size, as NAME@WHERE:coefficient=value")
        self._values = values[self.counted]
        self.described = None if described is None else self.extremes(*extreme_states(described))
        self.bounds = self.extremes.bounds(limits, self.described)
        self.before = None if described is None else motion_bounds(described, self.grade)
        self.series = Series(frequency, len(system.joints))

    @staticmethod
    def of(
        system: System,
        separate: Sequence[str],
        limits: Limits,
        duration: float | None,
        grade: str | None,
        random: np.random.Generator,
        progress: Callable[[str, float], None],
    ) -> Problem:
        """Frequencies beside described ones are drawn.

        InputError where nothing says how long and how large the motion may be.
        """
        trajectory = system.trajectory
        if trajectory is None and (duration is None or limits.angle is None):
            expected = "a trajectory, or both a duration and the largest joint angle"
            raise InputError(system.name, "trajectory", "no such table", expected)
        stated = [harmonic.frequency for joint in trajectory.joints for harmonic in joint] if trajectory else []
        length = duration if duration is not None else trajectory.duration if trajectory else math.nan
        if length > LONGEST:
            raise InputError(system.name, "duration", f"{length:g} s", f"a motion of {LONGEST:g} s at most")
        frequency = _frequencies(stated or [PERIODS * 2.0 * math.pi / length], random)
        described = None if trajectory is None else Simulated.of(system).solve(progress)
        pair = [text.partition(":")[0] for text in separate]

        def counted(name: str, value: float) -> bool:
            return any(name.startswith(f"{effect}.") for effect in pair) if pair else value > 0.0

        return Problem(system, length, grade, limits, described, frequency, counted)

    def keeps(self, duration: float | None) -> bool:
        """Whether the described motion is itself within the limits, and as long as the one asked for."""
        fits = self.described is not None and bool((self.described <= self.bounds).all())
        return fits and (self.system.trajectory is None or duration in (None, self.system.trajectory.duration))

    @property
    def smallest_angle(self) -> float:
        """Of the largest angles that joints may reach, rad (m): what a random series may ask for to begin with."""
        angles = [signal.kind == "angle" and signal.stated for signal in self.extremes.signals]
        return float(self.bounds[angles].min())

    @property
    def units(self) -> Array:
        """Amplitudes (size,), rad (m), by which series are changed: of alike torques of the controller, about."""
        controller = self.system.controller
        assert controller is not None  # of a system that has been simulated
        gains = np.array(controller.stiffness) + 1j * self.series.frequency[:, None] * np.array(controller.damping)
        # A passive joint has no gain, and its series is not changed.
        ratio = np.divide(gains[0], gains, out=np.zeros_like(gains), where=gains != 0.0)
        size = self.smallest_angle * np.abs(ratio)
        return np.asarray(np.broadcast_to(size, (2, *size.shape)).ravel())

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Of points (P, size): logarithms of relative bounds (P, counted), and loads (P, N, signals) at N instants.

        A load is a magnitude over its limit; inf where a motion cannot be followed.
        """
        motions = ensemble(self.system, self.series.frequency, *self.series(points), self.duration, STEP)
        bounds = np.full((len(points), self._values.size), np.inf)
        loads = np.full((len(points), motions.t.size, self.bounds.size), np.inf)
        for p in range(len(points)):
            x, v, inputs = motions.x[p], motions.v[p], motions.torque[p]
            if np.isfinite(x).all() and np.isfinite(v).all():
                loads[p] = self.extremes.magnitudes(x, v, inputs) / self.bounds
                motion = Motion(motions.t, x, v, inputs)
                std = cramer_rao_bound(self.plant.dynamics, self.base, [motion], self.sensors)
                bounds[p] = np.log(std[self.counted] / self._values)
        return bounds, loads


def extreme_states(simulation: Simulation) -> tuple[Array, Array, Array]:
    """x, v and n τ of a motion, close enough together for their extremes."""
    rate = simulation.plant.system.sample_rate
    t = np.linspace(0.0, simulation.duration, round(simulation.duration * rate) + 1)
    exact = exact_states(simulation, t)
    return exact.x, exact.v, exact.torque
