"""bound: the least standard deviation that any unbiased estimator can reach with a motion and a set of sensors."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from sms_adapters.sources import open_source
from sms_online.bound import STEP, MotionRecord, cramer_rao_bound, session_bound
from sms_online.description.channels import sensed_channels
from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.linearised import Motion
from sms_online.model.base_parameters import find_base_parameters
from sms_online.model.parameters import Parameter
from sms_online.sensor_set import SensorSet, readable_channels, sensor_set
from sms_online.stream import Array
from sms_sim.plant import Plant
from sms_sim.sensors import Sensors
from sms_sim.simulate import exact_states, simulate
from sms_tools.exit_codes import NOTHING_DETERMINED, OK
from sms_tools.interruption import Interruption
from sms_tools.report import report_console, show
from sms_tools.results_file import to_json
from sms_tools.session import described_system, new_estimator, stream

# A bound needs every drive measured, so these are never left out.
DRIVES = ("tau_", "force_")


@dataclass(frozen=True)
class Bounds:
    """Bounds (n,) at parameter values (n,).

    without: the same with one sensor of the description left out, by its channels.
    """

    parameters: tuple[Parameter, ...]
    value: Array
    bound: Array
    without: dict[str, Array]


def run(args: argparse.Namespace) -> int:
    """Print the bound of every parameter; 0, 3 where the motion determines none."""
    system, folder = described_system(args)
    bounds = _of_simulation(system, args) if args.capture is None else _of_capture(system, folder, args)
    show(report_console(args.json), _table(bounds))
    if args.json:
        print(to_json(_document(system, bounds)))
    return OK if np.isfinite(bounds.bound).any() else NOTHING_DETERMINED


def _of_simulation(system: System, args: argparse.Namespace) -> Bounds:
    plant = Plant(system)
    # Sensors come first: what is missing of them is known before a long simulation.
    described = _sensors(plant, system, args.grade)
    without = {}
    for k, sensor in enumerate(system.sensors if args.each_sensor else ()):
        if not any(channel.startswith(DRIVES) for channel in sensed_channels(system, sensor)):
            others = tuple(other for j, other in enumerate(system.sensors) if j != k)
            reduced = system.model_copy(update={"sensors": others})
            without[", ".join(sensor.channels)] = _sensors(plant, reduced, args.grade)
    try:
        simulation = simulate(system)
    except ArithmeticError as error:
        expected = "a motion that the integrator can follow"
        raise InputError(args.system, "trajectory and controller", str(error), expected) from None
    exact = exact_states(
        simulation, np.linspace(0.0, simulation.duration, max(1, round(simulation.duration / STEP)) + 1)
    )
    base, motion = find_base_parameters(plant.model), Motion(exact.t, exact.x, exact.v)

    def bound(sensors: SensorSet) -> Array:
        return cramer_rao_bound(plant.dynamics, base, [motion], sensors)

    reduced_bounds = {left: bound(sensors) for left, sensors in without.items()}
    return Bounds(base.parameters, base.values(plant.parameters), bound(described), reduced_bounds)


def _sensors(plant: Plant, system: System, grade: str | None) -> SensorSet:
    """The sensors that `system` describes on a plant, or those of positions and drives with a grade's noise."""
    readable = (*plant.channels[: len(system.joints)], *readable_channels(plant.model))
    sensors = Sensors(system, readable if grade is None else plant.channels, grade, seed=0)
    # Rounding to a resolution r adds r²/12.
    sigma = np.hypot(sensors.noise, sensors.resolution / math.sqrt(12.0))
    return sensor_set(plant.model, sensors.channels, sigma, sensors.rate)


def _of_capture(system: System, folder: Path | None, args: argparse.Namespace) -> Bounds:
    if args.grade is not None or args.each_sensor:
        expected = "neither with a capture, whose sensors are what they are"
        raise InputError("bound", "--grade, --each-sensor", "given", expected)
    capture: Path = args.capture
    source = open_source(capture, system, None, None, None, folder)
    estimator = new_estimator(system, source.channels, str(capture))
    record = MotionRecord(system.sample_rate)
    estimator.observers.append(record)
    with Interruption() as interruption:
        stream(estimator, source, interruption)
    bound = session_bound(estimator, record)
    none = np.full(estimator.base.n, np.inf)
    return Bounds(estimator.base.parameters, estimator.estimate().pi, none if bound is None else bound, {})


def _percent(bound: float, value: float) -> float | None:
    return 100.0 * bound / abs(value) if value and math.isfinite(bound) else None


def _table(bounds: Bounds) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column("parameter", overflow="fold")
    table.add_column("unit")
    for heading in ("value", "bound", "bound %", *(f"% without {left}" for left in bounds.without)):
        table.add_column(heading, justify="right")
    for k, parameter in enumerate(bounds.parameters):
        value, bound = bounds.value[k], bounds.bound[k]
        percents = [_percent(each[k], value) for each in (bounds.bound, *bounds.without.values())]
        shown = ["" if percent is None else f"{percent:.2g}" for percent in percents]
        numbers = f"{value:.6g}", f"{bound:.2g}" if math.isfinite(bound) else "none"
        table.add_row(parameter.name, parameter.unit, *numbers, *shown)
    return table


def _document(system: System, bounds: Bounds) -> dict[str, object]:
    parameters = [
        {
            "name": parameter.name,
            "symbol": parameter.symbol,
            "unit": parameter.unit,
            "value": float(bounds.value[k]),
            "bound": float(bounds.bound[k]),
            "bound_percent": _percent(float(bounds.bound[k]), float(bounds.value[k])),
            "bound_without": {left: float(each[k]) for left, each in bounds.without.items()},
        }
        for k, parameter in enumerate(bounds.parameters)
    ]
    return {"schema": "sms-online/bound/1", "system": system.name, "parameters": parameters}
