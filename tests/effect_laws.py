"""Effects' laws by formulas of their own, and forces of a size that simulations are made with."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import parse_effect
from sms_online.model.effect import Inputs
from sms_online.model.model import Model
from sms_online.stream import Array
from tests.model_systems import paper, random_states

GEAR, K, B = 50.0, 1000.0, 75.85  # of both joints of the planar example
STATES = 12
# Speeds of the planar example: x, y, θ_0, q_1, q_2, θ_m1, θ_m2, then four a link.
Q_1, M_1, M_2, LINK_2 = 3, 5, 6, slice(11, 15)


class Motion:
    """Random states of the planar example with random torques and internal states, seed 21."""

    def __init__(self, model: Model) -> None:
        rng = np.random.default_rng(21)
        self.x, self.v = random_states(model.layout, STATES, seed=21)
        self.tau = rng.normal(size=(STATES, 2))
        self.z = rng.normal(size=(STATES, model.n_states))
        self.inputs = Inputs(self.tau, self.z)
        self.delta = self.x[:, M_1] - self.x[:, Q_1]
        self.rate, self.link_rate = self.v[:, M_1], self.v[:, Q_1]
        self.theta_m = self.x[:, M_1]
        self.zero = np.zeros(STATES)


Law = Callable[[Motion], dict[int, Array]]


def with_effect(text: str, system: System | None = None) -> Model:
    system = paper() if system is None else system
    return build_model(system.model_copy(update={"effects": (parse_effect(text, system),)}))


def spring(force: Array) -> dict[int, Array]:
    return {M_1: force, Q_1: -force}


def _kinematic_error(s: Motion, amplitude: float, phase: float) -> dict[int, Array]:
    """Of a spring and a damper on δ + e."""
    psi, turns = 2 * GEAR * s.theta_m - phase, 2 * GEAR
    return spring(-K * amplitude * np.cos(psi) + B * amplitude * turns * np.sin(psi) * s.rate)


# Effect as declared to its generalized force, speed by speed.
LAWS: dict[str, Law] = {
    "viscous_friction@joint_1:damping=0.4": lambda s: {M_1: -0.4 * s.rate},
    "coulomb_friction@joint_1:torque=0.4": lambda s: {M_1: -0.4 * np.sign(s.rate)},
    "stribeck_friction@joint_1:torque=0.4,velocity=0.7": lambda s: {
        M_1: -0.4 * np.sign(s.rate) / np.exp(s.rate * s.rate / 0.49)
    },
    "presliding_friction@joint_1:torque=0.4,width=0.02": lambda s: {M_1: -0.4 * s.z[:, 0] / 0.02},
    "load_friction@joint_1:ratio=0.03": lambda s: {M_1: -0.03 * np.abs(K * s.delta) * np.sign(s.rate)},
    "direction_friction@joint_1:plus=0.4,minus=0.7": lambda s: {M_1: -np.where(s.rate > 0.0, 0.4, 0.7) * s.rate},
    "bearing_viscous_friction@joint_1:damping=0.4": lambda s: {Q_1: -0.4 * s.link_rate},
    "bearing_coulomb_friction@joint_1:torque=0.4": lambda s: {Q_1: -0.4 * np.sign(s.link_rate)},
    "torsional_hysteresis@joint_1:torque=0.4,width=0.02": lambda s: spring(-0.4 * s.z[:, 0] / 0.02),
    "cubic_stiffness@joint_1:stiffness=70": lambda s: spring(-70 * s.delta * s.delta**2),
    # What is left of the spring beyond the gap, less the spring itself.
    "backlash@joint_1:gap=0.6": lambda s: spring(
        K * s.delta - K * np.sign(s.delta) * np.maximum(np.abs(s.delta) - 0.6, 0.0)
    ),
    "kinematic_error@joint_1:amplitude=0.01,phase=0.3": lambda s: _kinematic_error(s, 0.01, 0.3),
    "cogging@joint_1:amplitude=0.4,phase=-2,order=3": lambda s: {M_1: 0.4 * np.cos(3 * GEAR * s.theta_m + 2)},
    "torque_ripple@joint_1:amplitude=0.04,phase=1,order=4": lambda s: {
        M_1: s.tau[:, 0] * 0.04 * np.cos(4 * GEAR * s.theta_m - 1)
    },
    "torque_gain@joint_2:ratio=0.1": lambda s: {M_2: 0.1 * s.tau[:, 1]},
    "torque_offset@joint_2:torque=0.1": lambda s: {M_2: s.zero - 0.1 * GEAR},
    "reaction_wheel@base:torque=0.3": lambda s: {2: s.zero + 0.3},
    "thruster_leak@base:force_x=0.3,force_y=0.5": lambda s: {
        0: 0.3 * np.cos(s.x[:, 2]) - 0.5 * np.sin(s.x[:, 2]),
        1: 0.3 * np.sin(s.x[:, 2]) + 0.5 * np.cos(s.x[:, 2]),
    },
    "air_drag@base:damping=3": lambda s: {0: -3 * s.v[:, 0], 1: -3 * s.v[:, 1]},
    "rotational_drag@base:damping=3": lambda s: {2: -3 * s.v[:, 2]},
    "cable_spring@base:stiffness=3,rest_x=0.1,rest_y=-2": lambda s: {
        0: 3 * (0.1 - s.x[:, 0]), 1: 3 * (-2 - s.x[:, 1])
    },
    "slosh@base:mass=2,stiffness=50": lambda s: {0: 50 * (s.z[:, 0] - s.x[:, 0]), 1: 50 * (s.z[:, 1] - s.x[:, 1])},
}  # fmt: skip

# Forces in a simulated session, together in one.
FORCES = (
    "viscous_friction@joint_1:damping=2",
    "coulomb_friction@joint_2:torque=1",
    "stribeck_friction@joint_1:torque=1,velocity=0.05",
    "presliding_friction@joint_1:torque=1,width=0.005",
    "load_friction@joint_1:ratio=0.02",
    "direction_friction@joint_1:plus=1,minus=0.5",
    "bearing_viscous_friction@joint_2:damping=2",
    "bearing_coulomb_friction@joint_1:torque=1",
    "torsional_hysteresis@joint_1:torque=5,width=0.01",
    "cubic_stiffness@joint_2:stiffness=2000",
    "backlash@joint_1:gap=0.002",
    "kinematic_error@joint_2:amplitude=0.0001,phase=0.5",
    "cogging@joint_1:amplitude=1,phase=0.3,order=2",
    "torque_ripple@joint_1:amplitude=0.02,phase=0.3,order=2",
    "link_damping@link_2:time=0.001",
    "link_mass_damping@link_1:rate=0.5",
    "tip_payload@tip:mass=1,inertia=0.1",
    "reaction_wheel@base:torque=0.5",
    "thruster_leak@base:force_x=0.5,force_y=0.2",
    "table_tilt@base:gravity_x=0.001,gravity_y=0.002",
    "air_drag@base:damping=5",
    "rotational_drag@base:damping=2",
    "cable_spring@base:stiffness=20",
    "slosh@base:mass=20,stiffness=500",
    "torque_gain@joint_2:ratio=0.03",
    "torque_offset@joint_1:torque=0.02",
)
