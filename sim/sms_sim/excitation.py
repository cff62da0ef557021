"""Trajectories that a system's parameters are best estimated from, as Fourier series within limits.

The criterion is the Cramér–Rao bound of the motion that the controller makes of the series: the largest of the relative
bounds, and their median. The described motion and series drawn at random, some of them about it, are scaled into the
limits; the best is improved by sequential linear programming: bounds and loads at all instants are
linearised from one batch of motions, and the linear program that minimises the largest bound within the limits, in a
box of amplitudes, gives the step. That is quick where many limits hold the motion at once, as a described motion's own
extremes do.
Source: Swevers, Ganseman, Tükel, De Schutter, Van Brussel, Optimal robot excitation and identification, IEEE Trans.
Robotics and Automation 13 (1997) 730, for finite Fourier series and the optimisation by the bound; Nocedal and
Wright, Numerical Optimization (2006), ch. 18, for linear programs in a trust region.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linprog

from sms_online.description.given import Given, given_system
from sms_online.description.schema import Effect, System, Trajectory
from sms_online.effects.build import declaring
from sms_online.effects.catalogue import parse_effect
from sms_online.errors import InputError
from sms_online.stream import Array
from sms_online.tables import Tabled
from sms_sim.bound import Bounds, motion_bounds
from sms_sim.capture import Simulated
from sms_sim.excitation_problem import Problem, extreme_states
from sms_sim.motion_limits import Limits
from sms_sim.simulate import Simulation

# Series that the best is chosen from.
DRAWN = 8
# Share of a random series in those about the described one, at most.
MIXED = 0.5
# Share of the median in the criterion, or nothing would keep the others from being spent for the worst.
MEDIAN_SHARE = 0.3
# Increment of amplitudes for derivatives, and the box of the first step, in their units.
INCREMENT, RADIUS = 4e-3, 4e-2
# Boxes that are tried in a step, over that of the last one; where none is better, the next are so much smaller.
BOXES, SMALLER = (2.0, 1.0, 0.25), 0.1
# Boxes below this end the search: what a step gains is then below what coarse motions leave of a bound.
LEAST_RADIUS = 1e-4
# Cost of a load beyond the limits, in logarithms of bounds: more than any bound gains by it.
PENALTY = 3.0
# The exact motion is scaled to this share of the limits until it is within them, so often.
USED, CORRECTIONS = 0.999, 6
# Steps of the optimiser by default: those that follow gain a tenth of what these do.
ITERATIONS = 4


@dataclass(frozen=True)
class Reached:
    """The largest magnitude that a motion reaches, beside its limit.

    limit: None where there is none. largest: magnitude that is reached. Both are in the unit.
    """

    name: str
    unit: str
    limit: float | None
    largest: float


@dataclass(frozen=True, repr=False)
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
    for `bound`. seed: of the draw of frequencies and series. iterations: steps of the optimiser at most. progress: what
    is being done, and the share of it that is done.
    Raises InputError where nothing limits the motion, an effect's size is not stated, or as `bound` does.
    """
    described, _ = given_system(system)
    weighed = _with_pair(described, separate)
    random = np.random.default_rng(seed)
    problem = Problem.of(weighed, separate, limits or Limits(), duration, grade, random, progress)
    best = _optimised(problem, random, iterations, progress)
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
        whole = declaring(system, effects)
        known = {effect.key: effect for effect in system.effects}
        head = text.partition(":")[0]
        if head in known:
            if ":" in text:
                expected = f"{head} alone, of the declared size"
                raise InputError("--separate", text, "an effect that the system file declares", expected)
            continue
        effects.append(parse_effect(text, whole, "--separate"))
    return declaring(system, effects)


def _criterion(bounds: Array, loads: Array) -> Array:
    """What is minimised (P,): the largest and the median bound of the motion scaled to the limits.

    Bounds fall as amplitudes rise.
    """
    largest = loads.max(axis=(1, 2))
    cost = (1.0 - MEDIAN_SHARE) * bounds.max(axis=1) + MEDIAN_SHARE * np.median(bounds, axis=1) + np.log(largest)
    return np.where(np.isfinite(cost), cost, np.inf)


def _optimised(
    problem: Problem, random: np.random.Generator, iterations: int, progress: Callable[[str, float], None]
) -> Array:
    """The best point that is found."""
    what, total = "designing the motion", 2 + iterations
    points = problem.series.drawn(random, DRAWN, problem.smallest_angle)
    if problem.system.trajectory is not None:
        # The described motion, and some with more or less of something else.
        share = np.linspace(0.0, MIXED, DRAWN // 2)[:, None]
        points[: DRAWN // 2] = problem.series.nearest(problem.system.trajectory) + share * points[: DRAWN // 2]
    progress(what, 0.0)
    load = problem(points)[1].max(axis=(1, 2))
    points = points / np.where(np.isfinite(load), load, 2.0)[:, None]
    progress(what, 1.0 / total)
    costs = _criterion(*problem(points))
    if not np.isfinite(costs).any():
        found = "no random motion within them determines the parameters"
        raise InputError(problem.system.name, "limits", found, "wider limits, or effects that such motions show")
    best = points[int(np.argmin(costs))]
    units, radius = problem.units, RADIUS
    for k in range(iterations):
        progress(what, (2.0 + k) / total)
        bounds, loads = problem(np.concatenate((best[None], best + INCREMENT * np.diag(units))))
        if not (np.isfinite(bounds).all() and np.isfinite(loads).all()):
            break  # at the edge of what can be followed
        boxes = radius * np.array(BOXES)
        trials = np.array([best + units * _step(bounds, loads, box) for box in boxes])
        costs = _criterion(*problem(trials))
        chosen = int(np.argmin(costs))
        if costs[chosen] < _criterion(bounds[:1], loads[:1])[0]:
            best, radius = trials[chosen], float(boxes[chosen])
        elif (radius := SMALLER * radius) < LEAST_RADIUS:
            break
    return np.asarray(best)


def _step(bounds: Array, loads: Array, box: float) -> Array:
    """Change of a point (size,), in units and within a box, that is best as far as bounds and loads are linear.

    bounds (1 + size, counted), loads (1 + size, N, signals): at the point, then with INCREMENT more of each amplitude.
    """
    slopes = (bounds[1:] - bounds[0]) / INCREMENT  # (size, counted)
    n, middle = len(slopes), np.argsort(bounds[0])[(bounds.shape[1] - 1) // 2 : bounds.shape[1] // 2 + 1]
    there, by_amplitude = loads[0].ravel(), ((loads[1:] - loads[0]) / INCREMENT).reshape(n, -1)
    near = there + box * np.abs(by_amplitude).sum(axis=0) > 1.0
    # Unknowns: the step, the logarithm of the largest bound, and the load beyond the limits.
    rows = np.concatenate((slopes, by_amplitude[:, near]), axis=1).T
    largest, beyond = np.zeros((2, len(rows), 1))
    largest[: bounds.shape[1]], beyond[bounds.shape[1] :] = -1.0, -1.0
    cost = np.concatenate((MEDIAN_SHARE * slopes[:, middle].mean(axis=1), [1.0 - MEDIAN_SHARE, PENALTY]))
    found = linprog(
        cost,
        A_ub=np.concatenate((rows, largest, beyond), axis=1),
        b_ub=np.concatenate((-bounds[0], 1.0 - there[near])),
        bounds=[*[(-box, box)] * n, (None, None), (0.0, None)],
    )
    return np.asarray(found.x[:n]) if found.x is not None else np.zeros(n)


def _exact(
    problem: Problem, point: Array, progress: Callable[[str, float], None]
) -> tuple[Trajectory, Simulation, Array]:
    """The trajectory of a point, scaled until its exact motion is within the limits, that motion and its extremes."""
    for k in range(CORRECTIONS):
        trajectory = problem.series.trajectory(point, problem.duration)
        moved = problem.system.model_copy(update={"trajectory": trajectory})
        simulation = Simulated.of(moved).solve(progress)
        extremes = problem.extremes(*extreme_states(simulation))
        load = float((extremes / problem.bounds).max())
        if load <= 1.0:
            return trajectory, simulation, extremes
        # A load may fall by less than amplitudes do: every correction takes more.
        point = point * (USED / load) ** (k + 1)
    raise InputError(problem.system.name, "limits", "no motion within them", "wider limits")
