"""Trajectories that a system's parameters are best estimated from, as Fourier series within limits.

The criterion is the Cramér–Rao bound of the motion that the controller makes of the series: a smooth maximum of the
relative bounds, so that the worst counts most. Series of several harmonics are drawn at random, some of them about the
described one, and scaled into the limits; the best is improved by quasi-Newton steps (BFGS), all derivatives of a step
from one batch of motions.
Source: Swevers, Ganseman, Tükel, De Schutter, Van Brussel, Optimal robot excitation and identification, IEEE Trans.
Robotics and Automation 13 (1997) 730, for finite Fourier series and the optimisation by the bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize

from sms_online.cramer_rao import cramer_rao_bound
from sms_online.description.given import Given, given_system
from sms_online.description.schema import Effect, Harmonic, System, Trajectory
from sms_online.effects.catalogue import parse_effect
from sms_online.errors import InputError
from sms_online.linearised import Motion
from sms_online.model.base_parameters import find_base_parameters
from sms_online.stream import Array
from sms_online.tables import Tabled
from sms_sim.bound import Bounds, motion_bounds, noisy_sensors
from sms_sim.capture import Simulated
from sms_sim.ensemble import ensemble
from sms_sim.motion_limits import Extremes, Limits
from sms_sim.plant import Plant
from sms_sim.simulate import Simulation, exact_states

# Harmonics of each joint: five free frequencies determine ten parameters a joint, and are slow enough to be followed.
HARMONICS = 5
# Periods of the slowest in a motion without a described one: several, of which each repeats what the others show.
PERIODS = 5
# Step of the motions that are compared and of their bounds, s: twice that of `cramer_rao`. The planar example's worst
# bound then comes out a tenth low, so that exact bounds decide in the end.
STEP = 0.02
# Random series that the best is chosen from, and how often they are scaled into the limits, which is not linear.
DRAWN, SCALINGS = 24, 1
# Share of a random series that is added to the described one, at most.
MIXED = 0.5
# Order of the norm of relative bounds: near their maximum, and smooth. The median takes so much of the criterion, or
# nothing would keep the others from being spent for the worst.
ORDER, MEDIAN_SHARE = 8, 0.3
# Order of the norm over signals and instants in place of the largest load.
PEAK_ORDER = 40
# Unit of the optimiser's amplitudes, rad (m): its first step is about as long as the criterion's slope in it, which
# then keeps a motion one that can be followed.
UNIT = 0.1
# Increment of a series' amplitudes, rad (m), for derivatives: a thousand times what is left of the motions' equations.
INCREMENT = 5e-3
# In place of what cannot be followed: more than any motion costs.
FAR = 1e3
# The exact motion is scaled to this share of the limits until it is within them, so often.
USED, CORRECTIONS = 0.999, 6
# Steps of the optimiser by default: the criterion then changes by less than a hundredth in a step.
ITERATIONS = 15


@dataclass(frozen=True)
class Reached:
    """The largest magnitude that a motion reaches, beside its limit.

    limit: None where there is none. largest: magnitude that is reached. Both are in the unit.
    """

    name: str
    unit: str
    limit: float | None
    largest: float


@dataclass(frozen=True)
class Excitation(Tabled):
    """A designed motion, or the described one if none was found with a lower bound of the worst parameter.

    system: with it as its trajectory. before, after: bounds of the described motion, None where there is none, and of
    this one. weighed: names of the parameters that it was designed for. reached: its extremes.
    """

    system: System
    before: Bounds | None
    after: Bounds
    weighed: tuple[str, ...]
    reached: tuple[Reached, ...]

    def gains(self) -> dict[str, float | None]:
        """Factor by which each bound is lower than before; None if there is none to compare."""
        out: dict[str, float | None] = {}
        for name, after in self.after.parameters.items():
            before = math.nan if self.before is None else self.before.parameters[name].std
            out[name] = before / after.std if math.isfinite(before) and math.isfinite(after.std) else None
        return out

    def rows(self) -> tuple[list[str], list[list[str]]]:
        """Headings, and a row of cells for each parameter that the motion was designed for."""
        gains, rows = self.gains(), []
        for name in self.weighed:
            after = self.after.parameters[name]
            before = None if self.before is None else self.before.parameters[name].percent
            gain = gains[name]
            shares = ["none" if share is None else f"{share:.2g}" for share in (before, after.percent)]
            rows.append([name, after.unit, f"{after.value:.6g}", *shares, "" if gain is None else f"{gain:.2f}"])
        return ["parameter", "unit", "value", "bound % before", "after", "times lower"], rows

    def document(self) -> dict[str, Any]:
        """The same as plain lists, dictionaries and numbers."""
        assert self.system.trajectory is not None
        return {
            "schema": "sms-online/excitation/1",
            "system": self.system.name,
            "weighed": list(self.weighed),
            "trajectory": self.system.trajectory.model_dump(mode="json"),
            "before": None if self.before is None else self.before.document(),
            "after": self.after.document(),
            "times_lower": self.gains(),
            "reached": [vars(each) for each in self.reached],
        }


def excite(
    system: Given,
    *,
    limits: Limits | None = None,
    duration: float | None = None,
    separate: Sequence[str] = (),
    grade: str | None = None,
    seed: int = 0,
    iterations: int = ITERATIONS,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> Excitation:
    """Design the trajectory from which the parameters of a system are best estimated, by the Cramér–Rao bound.

    system: described, or its name or file, with a controller. limits: see `Limits`; duration: s; by default the
    described motion's own. separate: two effects, "name@where:coefficient=value", whose coefficients are to be
    estimated beside each other; without them all parameters count that are not nominally zero. grade: of the noise, as
    for `bound`. seed: of the draw. iterations: steps of the optimiser at most. progress: what is being done, and the
    share of it that is done.
    Raises InputError where nothing limits the motion, an effect's size is not stated, or as `bound` does.
    """
    described, _ = given_system(system)
    weighed = _with_pair(described, separate)
    problem = _Problem.of(weighed, separate, limits or Limits(), duration, grade, progress)
    best = _optimised(problem, np.random.default_rng(seed), iterations, progress)
    trajectory, simulation, extremes = _exact(problem, best, progress)
    after = motion_bounds(simulation, problem.grade)
    names = tuple(p.name for k, p in enumerate(problem.base.parameters) if problem.counted[k])
    if problem.keeps(duration) and problem.before is not None and problem.described is not None:
        # Coarser steps may have misled the search: exact bounds decide.
        worst = [max(p.std / abs(p.value) for p in map(b.parameters.get, names) if p) for b in (problem.before, after)]
        if worst[0] <= worst[1] and described.trajectory is not None:
            trajectory, extremes, after = described.trajectory, problem.described, problem.before
    reached = tuple(
        Reached(signal.name, signal.unit, float(limit) if np.isfinite(limit) else None, float(largest))
        for signal, limit, largest in zip(problem.extremes.signals, problem.bounds, extremes, strict=True)
    )
    final = described.model_copy(update={"trajectory": trajectory})
    return Excitation(final, problem.before, after, names, reached)


def _with_pair(system: System, separate: Sequence[str]) -> System:
    """The system with the two effects declared."""
    if separate and len(separate) != 2:
        raise InputError("--separate", "", f"{len(separate)} effects", "two")
    effects: list[Effect] = []
    for text in separate:
        whole = system.model_copy(update={"effects": (*system.effects, *effects)})
        known = {(e.name, e.where): e for e in system.effects}
        head = text.partition(":")[0]
        if ":" not in text and tuple(head.split("@")) in known:
            continue
        effects.append(parse_effect(text, whole))
    return system.model_copy(update={"effects": (*system.effects, *effects)})


class _Series:
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
        """Point (size,) of a described series' terms at these frequencies; others are left out."""
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


class _Problem:
    """Criterion and loads of series. bounds (signals,): largest magnitudes; counted (n,): parameters that matter."""

    def __init__(
        self,
        system: System,
        duration: float,
        grade: str | None,
        limits: Limits,
        described: Simulation | None,
        lowest: float,
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
        self.described = None if described is None else self.extremes(*_states(described))
        self.bounds = self.extremes.bounds(limits, self.described)
        self.before = None if described is None else motion_bounds(described, self.grade)
        self.series = _Series(lowest * np.arange(1.0, HARMONICS + 1.0), len(system.joints))

    @staticmethod
    def of(
        system: System,
        separate: Sequence[str],
        limits: Limits,
        duration: float | None,
        grade: str | None,
        progress: Callable[[str, float], None],
    ) -> _Problem:
        """InputError where nothing says how long and how large the motion may be."""
        trajectory = system.trajectory
        if trajectory is None and (duration is None or limits.angle is None):
            expected = "a trajectory, or both a duration and the largest joint angle"
            raise InputError(system.name, "trajectory", "no such table", expected)
        described = None if trajectory is None else Simulated.of(system).solve(progress)
        stated = [harmonic.frequency for joint in trajectory.joints for harmonic in joint] if trajectory else []
        length = duration if duration is not None else trajectory.duration if trajectory else math.nan
        lowest = min(stated, default=PERIODS * 2.0 * math.pi / length)
        pair = [text.partition(":")[0] for text in separate]

        def counted(name: str, value: float) -> bool:
            return any(name.startswith(f"{effect}.") for effect in pair) if pair else value > 0.0

        return _Problem(system, length, grade, limits, described, lowest, counted)

    def keeps(self, duration: float | None) -> bool:
        """Whether the described motion is itself within the limits, and as long as the one asked for."""
        fits = self.described is not None and bool((self.described <= self.bounds).all())
        return fits and (self.system.trajectory is None or duration in (None, self.system.trajectory.duration))

    @property
    def smallest_angle(self) -> float:
        """Of the largest angles that joints may reach, rad (m): what a random series may ask for to begin with."""
        angles = [signal.kind == "angle" and signal.stated for signal in self.extremes.signals]
        return float(self.bounds[angles].min())

    def __call__(self, points: Array) -> tuple[Array, Array, Array]:
        """Of points (P, size): criterion, largest load (extreme over its bound), and a smooth maximum (P,)."""
        motions = ensemble(self.system, self.series.frequency, *self.series(points), self.duration, STEP)
        cost, load, smooth = np.full((3, len(points)), np.inf)
        for p in range(len(points)):
            x, v = motions.x[p], motions.v[p]
            if np.isfinite(x).all() and np.isfinite(v).all():
                loads = self.extremes.magnitudes(x, v, motions.torque[p]) / self.bounds
                load[p], smooth[p] = loads.max(), np.linalg.norm(loads.ravel(), PEAK_ORDER)
                cost[p] = self._criterion(Motion(motions.t, x, v))
        return cost, load, smooth

    def _criterion(self, motion: Motion) -> float:
        std = cramer_rao_bound(self.plant.dynamics, self.base, [motion], self.sensors)[self.counted]
        relative = std / self._values
        if not np.isfinite(relative).all():
            return math.inf
        worst = math.log(float(np.linalg.norm(relative, ORDER)))
        return (1.0 - MEDIAN_SHARE) * worst + MEDIAN_SHARE * math.log(float(np.median(relative)))


def _states(simulation: Simulation) -> tuple[Array, Array, Array]:
    """x, v and n τ of a motion, close enough together for their extremes."""
    rate = simulation.plant.system.sample_rate
    t = np.linspace(0.0, simulation.duration, round(simulation.duration * rate) + 1)
    exact = exact_states(simulation, t)
    return exact.x, exact.v, exact.torque


def _optimised(
    problem: _Problem, random: np.random.Generator, iterations: int, progress: Callable[[str, float], None]
) -> Array:
    """The best point that is found."""
    what = "designing the motion"
    total = SCALINGS + 1 + iterations
    points = problem.series.drawn(random, DRAWN, problem.smallest_angle)
    if problem.system.trajectory is not None:
        # Some are the described motion with more or less of something else; the first is itself.
        share = np.linspace(0.0, MIXED, DRAWN // 2)[:, None]
        points[: DRAWN // 2] = problem.series.nearest(problem.system.trajectory) + share * points[: DRAWN // 2]
    for k in range(SCALINGS):
        progress(what, k / total)
        _, load, _ = problem(points)
        points = points / np.where(np.isfinite(load), load, 2.0)[:, None]
    progress(what, SCALINGS / total)
    cost, load, _ = problem(points)
    scaled = cost + np.log(load)
    if not np.isfinite(scaled).any():
        found = "no random motion within them determines the parameters"
        raise InputError(problem.system.name, "limits", found, "wider limits, or effects that such motions show")
    steps = _Steps(problem, lambda n: progress(what, min(1.0, (SCALINGS + 1 + n) / total)))
    begin = points[int(np.argmin(scaled))] / UNIT
    minimize(steps.cost, begin, jac=steps.slope, method="BFGS", options={"maxiter": iterations})
    return steps.best


class _Steps:
    """What is minimised, and its derivatives, at a point in UNIT, all from one batch of motions.

    It is the criterion of the motion scaled to the limits: bounds fall as amplitudes rise. So no limit is in the way of
    a step, and amplitudes stay where motions are close to their limits for the second term's sake.
    """

    def __init__(self, problem: _Problem, on_step: Callable[[int], None]) -> None:
        self._problem, self._on_step = problem, on_step
        self._known: dict[bytes, tuple[float, Array]] = {}
        self.best, self._least = np.empty(0), math.inf

    def cost(self, point: Array) -> float:
        """What is minimised."""
        return self._at(point)[0]

    def slope(self, point: Array) -> Array:
        """Its derivative (size,)."""
        return self._at(point)[1]

    def _at(self, scaled: Array) -> tuple[float, Array]:
        key, point = scaled.tobytes(), UNIT * scaled
        if key not in self._known:
            near = np.concatenate((point[None], point + INCREMENT * np.eye(point.size)))
            cost, load, smooth = self._problem(near)
            value = np.nan_to_num(cost + np.log(smooth) + np.log(smooth) ** 2, nan=FAR, posinf=FAR)
            self._known[key] = float(value[0]), (value[1:] - value[0]) * (UNIT / INCREMENT)
            if cost[0] + math.log(load[0]) < self._least:
                self.best, self._least = point, float(cost[0] + math.log(load[0]))
            self._on_step(len(self._known))
        return self._known[key]


def _exact(
    problem: _Problem, point: Array, progress: Callable[[str, float], None]
) -> tuple[Trajectory, Simulation, Array]:
    """The trajectory of a point, scaled until its exact motion is within the limits, that motion and its extremes."""
    for _ in range(CORRECTIONS):
        trajectory = problem.series.trajectory(point, problem.duration)
        moved = problem.system.model_copy(update={"trajectory": trajectory})
        simulation = Simulated.of(moved).solve(progress)
        extremes = problem.extremes(*_states(simulation))
        load = float((extremes / problem.bounds).max())
        if load <= 1.0:
            return trajectory, simulation, extremes
        point = point * (USED / load)
    raise InputError(problem.system.name, "limits", "no motion within them", "wider limits")
