"""Cramér–Rao bounds of a described trajectory, which is simulated, or of a recorded motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sms_online.cramer_rao import STEP, MotionRecord, cramer_rao_bound, session_bound
from sms_online.data import Data, recorded_session
from sms_online.description.channels import drive_channels, sensed_channels, wrench_channels
from sms_online.description.given import Given, given_system
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.linearised import Motion
from sms_online.model.base_parameters import find_base_parameters
from sms_online.model.readings import readable_channels
from sms_online.pipeline.estimator import Estimator
from sms_online.priors import known_beforehand
from sms_online.sensor_set import SensorSet, sensor_set
from sms_online.stream import Array
from sms_online.tables import Tabled
from sms_sim.capture import Simulated
from sms_sim.plant import Plant
from sms_sim.sensors import Sensors
from sms_sim.simulate import Simulation, exact_states

# A bound needs every drive and wrench measured, so these are never left out.
DRIVES = ("tau_", "force_", "wrench_")
# Noise of sensors whose system states none, as that of the demo.
DEFAULT_GRADE = "B"


@dataclass(frozen=True)
class Bound:
    """The least standard deviation that any unbiased estimator can reach of a parameter, at its value, in its unit.

    std: inf where the motion does not determine it. without: the same without one of the described sensors, by its
    channels.
    """

    name: str
    symbol: str
    unit: str
    value: float
    std: float
    without: Mapping[str, float]

    @property
    def percent(self) -> float | None:
        """The bound in per cent of the value; None where there is none."""
        return percent(self.std, self.value)


def percent(std: float, value: float) -> float | None:
    """A bound in per cent of a value."""
    return 100.0 * std / abs(value) if value and math.isfinite(std) else None


@dataclass(frozen=True, repr=False)
class Bounds(Tabled):
    """Cramér–Rao bounds of a system's parameters, for a motion and a set of sensors; parameters: by name.

    grade: of the noise, None where it is the described or recorded one.
    """

    system: str
    parameters: Mapping[str, Bound]
    grade: str | None

    def rows(self) -> tuple[list[str], list[list[str]]]:
        """Headings, and a row of cells for each parameter."""
        left_out = [*next(iter(self.parameters.values())).without] if self.parameters else []
        headings = ["parameter", "unit", "value", "bound", "bound %", *(f"% without {left}" for left in left_out)]
        rows = []
        for p in self.parameters.values():
            shares = [p.percent, *(percent(p.without[left], p.value) for left in left_out)]
            shown = ["" if share is None else f"{share:.2g}" for share in shares]
            rows.append([p.name, p.unit, f"{p.value:.6g}", f"{p.std:.2g}" if math.isfinite(p.std) else "none", *shown])
        return headings, rows

    def document(self) -> dict[str, Any]:
        """The same as plain lists, dictionaries and numbers."""
        parameters = [
            {
                "name": p.name,
                "symbol": p.symbol,
                "unit": p.unit,
                "value": p.value,
                "bound": p.std,
                "bound_percent": p.percent,
                "bound_without": dict(p.without),
            }
            for p in self.parameters.values()
        ]
        return {"schema": "sms-online/bound/1", "system": self.system, "grade": self.grade, "parameters": parameters}


def bound(
    system: Given,
    data: Data | None = None,
    *,
    grade: str | None = None,
    each_sensor: bool = False,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> Bounds:
    """The least standard deviation of each parameter that a motion and its sensors allow (Cramér–Rao).

    system: described, or its name or file. data: recorded samples, whose sensors are what they are; without them the
    described trajectory is simulated. grade: noise in place of the described one, "A", "B" or "C"; "B" where a sensor's
    is not described. each_sensor: also without each of the described sensors. progress: of a simulation, see
    `Simulated.solve`. Raises InputError where there is no trajectory, a drive is not measured, or an effect needs more
    than a motion holds.
    """
    system, folder = given_system(system)
    if data is None:
        return _of_simulation(system, grade, each_sensor, progress)
    if grade is not None or each_sensor:
        expected = "neither with a capture, whose sensors are what they are"
        raise InputError("bound", "--grade, --each-sensor", "given", expected)
    recorded = recorded_session(system, data, folder)
    estimator = Estimator(system, tuple(recorded.source.channels), recorded.name)
    if (prior := known_beforehand(system, estimator.base, prior=False)) is not None:
        estimator.set_prior(prior)
    record = MotionRecord(system.sample_rate)
    estimator.observers.append(record)
    for block in recorded.source:
        estimator.push(block)
    estimator.finish()
    least = session_bound(estimator, record)
    base = estimator.base
    return _bounds(
        system, base.parameters, estimator.estimate().pi, np.full(base.n, np.inf) if least is None else least
    )


def _of_simulation(
    system: System, grade: str | None, each_sensor: bool, progress: Callable[[str, float], None]
) -> Bounds:
    if system.trajectory is None:
        raise InputError(system.name, "trajectory", "no such table", "a trajectory, or a capture")
    plant = Plant(system)
    # Sensors come first: what is missing of them is known before a long simulation.
    _, grade = noisy_sensors(plant, grade)
    without = {}
    for k, sensor in enumerate(system.sensors if each_sensor else ()):
        if not any(channel.startswith(DRIVES) for channel in sensed_channels(system, sensor)):
            others = tuple(other for j, other in enumerate(system.sensors) if j != k)
            reduced = system.model_copy(update={"sensors": others})
            without[", ".join(sensor.channels)] = _sensors(plant, reduced, grade)
    return motion_bounds(Simulated.of(system).solve(progress), grade, without)


def noisy_sensors(plant: Plant, grade: str | None) -> tuple[SensorSet, str | None]:
    """The sensors of a plant, and the grade of their noise where it is not described.

    grade: in place of the described noise; DEFAULT_GRADE where a sensor has none. Raises InputError where a drive is
    not measured, or a channel has no model of its reading.
    """
    if grade is None and not _noise(Sensors(plant.system, _readable(plant), None, seed=0)).all():
        grade = DEFAULT_GRADE
    return _sensors(plant, plant.system, grade), grade


def motion_bounds(
    simulation: Simulation, grade: str | None = None, without: Mapping[str, SensorSet] | None = None
) -> Bounds:
    """Bounds of a simulated motion. grade: see `noisy_sensors`. without: sensors that are left, by what is left out."""
    plant = simulation.plant
    described, grade = noisy_sensors(plant, grade)
    instants = np.linspace(0.0, simulation.duration, max(1, round(simulation.duration / STEP)) + 1)
    exact = exact_states(simulation, instants)
    base, motion = find_base_parameters(plant.model), Motion(exact.t, exact.x, exact.v, exact.torque)

    def least(sensors: SensorSet) -> Array:
        return cramer_rao_bound(plant.dynamics, base, [motion], sensors)

    reduced = {left: least(sensors) for left, sensors in (without or {}).items()}
    values = base.values(plant.parameters)
    return _bounds(plant.system, base.parameters, values, least(described), reduced, grade)


def _bounds(
    system: System,
    parameters: Iterable[Any],
    values: Array,
    stds: Array,
    without: Mapping[str, Array] | None = None,
    grade: str | None = None,
) -> Bounds:
    return Bounds(
        system.name,
        {
            p.name: Bound(
                p.name,
                p.symbol,
                p.unit,
                float(values[k]),
                float(stds[k]),
                {left: float(each[k]) for left, each in (without or {}).items()},
            )
            for k, p in enumerate(parameters)
        },
        grade,
    )


def _sensors(plant: Plant, system: System, grade: str | None) -> SensorSet:
    """The sensors that `system` describes on a plant, or those of positions and drives with a grade's noise."""
    sensors = Sensors(system, _readable(plant) if grade is None else plant.channels, grade, seed=0)
    return sensor_set(plant.model, sensors.channels, _noise(sensors), sensors.rate)


def _readable(plant: Plant) -> tuple[str, ...]:
    system = plant.system
    return (*drive_channels(system), *wrench_channels(system), *readable_channels(plant.model))


def _noise(sensors: Sensors) -> Array:
    """σ (channels,) of a sample; rounding to a resolution r adds r²/12."""
    return np.asarray(np.hypot(sensors.noise, sensors.resolution / math.sqrt(12.0)))
