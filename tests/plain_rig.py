"""A plain rig: the planar example with 17-bit encoders, a gyro, a slow tracker and markers without slopes."""

from __future__ import annotations

import math

import numpy as np

from sms_adapters.system_file import load_system
from sms_online.cramer_rao import STEP, cramer_rao_bound
from sms_online.description.schema import Sensor, System
from sms_online.linearised import Motion
from sms_online.model.base_parameters import find_base_parameters
from sms_online.model.readings import readable_channels
from sms_online.sensor_set import sensor_set
from sms_online.stream import Array
from sms_sim.sensors import Sensors
from sms_sim.simulate import Simulation, exact_states

TRACKER_RATE = 240.0  # Hz
SENSORS = (
    Sensor(channels=("tau_*",), noise=0.01),  # 0.5 N m after the gear
    Sensor(channels=("theta_m_*", "q_*"), resolution=2.0 * math.pi / 2**17),
    Sensor(channels=("r_S_*", "theta_0"), rate=TRACKER_RATE, noise=1e-4),
    Sensor(channels=("gyro_0_z",), noise=1e-4),
    Sensor(channels=("link_*.marker_*.u_y",), rate=TRACKER_RATE, noise=1e-4),
)


def plain_rig() -> System:
    """The paper's example with the sensors of a plain rig."""
    return load_system("paper-planar").model_copy(update={"sensors": SENSORS})


def bound_of(simulation: Simulation) -> Array:
    """Cramér-Rao bound (n,) of a simulated motion and the sensors that its system describes."""
    plant, system = simulation.plant, simulation.plant.system
    exact = exact_states(simulation, np.linspace(0.0, simulation.duration, round(simulation.duration / STEP) + 1))
    readable = (*plant.channels[: len(system.joints)], *readable_channels(plant.model))
    sensors = Sensors(system, readable, None, seed=0)
    sigma = np.hypot(sensors.noise, sensors.resolution / math.sqrt(12.0))
    chosen = sensor_set(plant.model, sensors.channels, sigma, sensors.rate)
    motion = Motion(exact.t, exact.x, exact.v)
    return cramer_rao_bound(plant.dynamics, find_base_parameters(plant.model), [motion], chosen)
