"""Systems and states that the model's tests share."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sms_online.description.bodies import (
    Deformation,
    FixedJoint,
    FlexibleLink,
    Inertia,
    Joint,
    Motor,
    RigidBody,
    RigidLink,
    Spacecraft,
)
from sms_online.description.schema import Effect, System
from sms_online.model.layout import Layout
from sms_online.model.model import Model
from sms_online.stream import Array

ASYMMETRIC = Inertia(xx=0.31, yy=0.42, zz=0.53, xy=0.011, xz=0.023, yz=-0.032)
FRICTION = (
    Effect(name="viscous_friction", where="joint_1", coefficients={"damping": 2.0}),
    Effect(name="coulomb_friction", where="joint_2", coefficients={"torque": 0.7}),
    Effect(name="torque_offset", where="joint_1", coefficients={"torque": 0.03}),
)


def planar_link(elements: int = 2, kinematics: str = "linear", flexural_rigidity: float = 1768.8) -> FlexibleLink:
    """A link of the paper's Table III."""
    return FlexibleLink(
        kind="flexible",
        length=1.2,
        elements=elements,
        mass_per_length=31.42,
        polar_inertia_per_length=0.1885 / 1.2,
        flexural_rigidity_z=flexural_rigidity,
        deformations=("bending_z",),
        kinematics=kinematics,
    )


def paper(
    kinematics: str = "linear", motion: str = "planar", free: bool = True, effects: Sequence[Effect] = ()
) -> System:
    """The paper's example, Tables I to III; as `spatial` motion the same bodies, or the arm alone on a fixed base."""
    motor = Motor(mass=3, rotor_inertia=0.0075, stator_inertia=Inertia(zz=0.0075))
    joint = Joint(gear_ratio=50, stiffness=1000, damping=75.85)
    spacecraft = Spacecraft(mass=400, center_of_mass=(-1, -1, 0), inertia=Inertia(zz=65), tracked_point=(-1, -2, 0))
    return System(
        name="paper",
        motion=motion,
        spacecraft=spacecraft if free else None,
        joints=(joint, joint),
        motors=(motor, motor),
        links=(planar_link(kinematics=kinematics), planar_link(kinematics=kinematics, flexural_rigidity=597.87)),
        effects=tuple(effects),
    )


def spatial_link(kinematics: str, elements: int = 2) -> FlexibleLink:
    """A link with every deformation that its kinematics has."""
    deformations: tuple[Deformation, ...] = ("bending_z", "bending_y", "torsion")
    return FlexibleLink(
        kind="flexible",
        length=1.2,
        elements=elements,
        mass_per_length=5.0,
        polar_inertia_per_length=0.12,
        flexural_rigidity_z=300.0,
        flexural_rigidity_y=400.0,
        torsional_rigidity=150.0,
        axial_rigidity=1e4,
        deformations=deformations if kinematics == "exact" else (*deformations, "traction"),
        kinematics=kinematics,
    )


def spatial(kinematics: str = "linear", free: bool = True) -> System:
    """All at once: skew axes, turned mounts, a rigid and a prismatic joint, a rigid link, payload, gravity, effects."""
    motor = Motor(mass=3.0, rotor_inertia=0.0075, stator_inertia=Inertia(xx=0.01, yy=0.02, zz=0.0075, xy=0.001))
    spacecraft = Spacecraft(
        mass=40.0,
        center_of_mass=(-1.0, -1.0, 0.3),
        inertia=Inertia(xx=50, yy=60, zz=65, xy=3, xz=-4, yz=5),
        tracked_point=(-1.0, -2.0, 0.5),
    )
    return System(
        name="spatial",
        gravity=(0.3, -0.5, -9.81),
        spacecraft=spacecraft if free else None,
        joints=(
            Joint(gear_ratio=50, stiffness=1000, damping=75.85),
            Joint(gear_ratio=30, axis=(0, 1, 0), mount_rotation=(0.3, -0.4, 0.5), transmission="rigid"),
            Joint(kind="prismatic", axis=(0, 0.6, 0.8), gear_ratio=20, stiffness=500, damping=7),
            Joint(gear_ratio=50, axis=(1, 0, 0), stiffness=800, damping=5),
        ),
        motors=(motor, motor, motor, motor),
        links=(
            spatial_link(kinematics),
            RigidLink(kind="rigid", mass=3, center_of_mass=(0.2, 0.1, -0.05), inertia=ASYMMETRIC, tip=(0.5, 0.1, 0.2)),
            spatial_link(kinematics, elements=1),
            spatial_link(kinematics),
        ),
        payload=RigidBody(mass=2.0, center_of_mass=(0.1, 0.2, 0.3), inertia=ASYMMETRIC),
        effects=FRICTION,
    )


def tree(kinematics: str = "exact", free: bool = True) -> System:
    """Two arms and a panel on a base: brackets at both ends of flexible links, a universal joint, passive joints.

    Joints 1 to 3: an arm with a flexible link between two brackets (link 7, with mass, at its end) and a cross. Joint
    4: a flexible panel on a passive hinge. Joints 5 and 6: an arm on the base, its last link on a passive
    slide. Link 8 is fixed to the base.
    """
    motor = Motor(mass=3.0, rotor_inertia=0.0075, stator_inertia=Inertia(xx=0.01, yy=0.02, zz=0.0075, xy=0.001))
    bracket = {"root_position": (0.1, -0.05, 0.2), "root_rotation": (0.2, -0.3, 0.4)}
    rigid = RigidLink(kind="rigid", mass=3, center_of_mass=(0.2, 0.1, -0.05), inertia=ASYMMETRIC, tip=(0.5, 0.1, 0.2))
    flexible = spatial_link(kinematics).model_copy(update=bracket)
    free_base = spatial(free=free)
    return System(
        name="tree",
        gravity=(0.3, -0.5, -9.81),
        spacecraft=free_base.spacecraft,
        joints=(
            Joint(gear_ratio=50, stiffness=1000, damping=75.85),
            Joint(gear_ratio=30, axis=(0, 1, 0), transmission="rigid", parent="link_7"),
            Joint(axis=(1, 0, 0), gear_ratio=20, stiffness=500, damping=7, mount_rotation=(0.0, 0.1, 0.0)),
            Joint(axis=(0, 1, 0), passive=True, stiffness=30, damping=0.5, parent="base", mount_position=(-1, 1, 0)),
            Joint(
                gear_ratio=50, stiffness=800, damping=5, parent="base",
                mount_position=(0.3, -1.2, 0.1), mount_rotation=(0.1, 0.2, 1.4),
            ),
            Joint(kind="prismatic", axis=(0, 0.6, 0.8), passive=True, transmission="rigid", mount_position=(0, 0.1, 0)),
        ),
        motors=(motor, motor, motor, None, motor, None),
        fixed_joints=(
            FixedJoint(kind="fixed", parent="link_1", mount_position=(0.05, 0.1, 0), mount_rotation=(0.3, 0, -0.5)),
            FixedJoint(kind="fixed", parent="base", mount_position=(0, 0, -0.4)),
        ),
        links=(
            flexible,
            RigidLink(kind="cross"),
            rigid,
            spatial_link(kinematics, elements=1),
            flexible,
            rigid,
            rigid.model_copy(update={"mass": 0.8}),
            rigid,
        ),
        payload=RigidBody(mass=2.0, center_of_mass=(0.1, 0.2, 0.3), inertia=ASYMMETRIC),
        effects=FRICTION,
    )  # fmt: skip


SYSTEMS = {
    "planar linear": paper("linear", effects=FRICTION),
    "planar exact": paper("exact", effects=FRICTION),
    "spatial linear": spatial("linear"),
    "spatial exact": spatial("exact"),
    "fixed base": spatial("exact", free=False),
    "tree linear": tree("linear"),
    "tree exact, fixed base": tree("exact", free=False),
}


def rigid_chain(joints: int, free: bool, prismatic: int | None = None, motors: bool = False) -> System:
    """Rigid links with rigid joints about skew axes in turned mounts, joint `prismatic` (from 1) sliding; seed 5."""
    rng = np.random.default_rng(5)

    def vector(scale: float) -> tuple[float, float, float]:
        x, y, z = rng.uniform(-scale, scale, size=3)
        return (float(x), float(y), float(z))

    def inertia(scale: float) -> Inertia:
        A = rng.uniform(-1.0, 1.0, size=(3, 3))
        spd = scale * (A @ A.T + np.eye(3))
        return Inertia(xx=spd[0, 0], yy=spd[1, 1], zz=spd[2, 2], xy=spd[0, 1], xz=spd[0, 2], yz=spd[1, 2])

    def unit() -> tuple[float, float, float]:
        x, y, z = (a := rng.normal(size=3)) / np.linalg.norm(a)
        return (float(x), float(y), float(z))

    return System(
        name="rigid",
        gravity=(0.3, -0.5, -9.81),
        spacecraft=Spacecraft(mass=30.0, center_of_mass=vector(0.5), inertia=inertia(2.0), tracked_point=vector(0.8))
        if free
        else None,
        joints=tuple(
            Joint(
                kind="prismatic" if i == prismatic else "revolute",
                axis=unit(),
                mount_rotation=vector(1.5),
                gear_ratio=float(rng.uniform(20, 60)),
                transmission="rigid",
            )
            for i in range(1, joints + 1)
        ),
        motors=tuple(
            Motor(mass=1.5, rotor_inertia=0.002, stator_inertia=inertia(0.01)) if motors else None
            for _ in range(joints)
        ),
        links=tuple(
            RigidLink(kind="rigid", mass=float(m), center_of_mass=vector(0.4), inertia=inertia(0.3), tip=vector(0.7))
            for m in rng.uniform(1.0, 5.0, size=joints)
        ),
        payload=RigidBody(mass=2.0, center_of_mass=vector(0.2), inertia=inertia(0.05)),
    )


def random_states(layout: Layout, count: int, seed: int, elastic: float = 0.2) -> tuple[Array, Array]:
    """Positions x (count, n_x) and speeds v (count, n_v): standard normal, elastic coordinates `elastic` times that."""
    rng = np.random.default_rng(seed)
    x, v = rng.normal(size=(count, layout.n_x)), rng.normal(size=(count, layout.n_v))
    offset = layout.offset
    for s in layout.q_f:
        x[:, s.start + offset : s.stop + offset] *= elastic
    if layout.free and not layout.planar:
        x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1)[:, None]
    return x, v


def move(model: Model, x: Array, v: Array, a: Array, t: float, steps: int = 8) -> tuple[Array, Array]:
    """State after t seconds of constant v̇ = a, by Runge–Kutta of order four."""
    h = t / steps
    for k in range(steps):

        def rate(x: Array, time: float) -> Array:
            return model.position_rate(x, v + time * a)

        k1 = rate(x, k * h)
        k2 = rate(x + 0.5 * h * k1, (k + 0.5) * h)
        k3 = rate(x + 0.5 * h * k2, (k + 0.5) * h)
        k4 = rate(x + h * k3, (k + 1) * h)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return x, v + t * a


# Central difference of order eight: weights of f(kh) - f(-kh), k = 1…4, over h.
DIFFERENCE = (4.0 / 5.0, -1.0 / 5.0, 4.0 / 105.0, -1.0 / 280.0)


def difference(f: Callable[[float], Array], step: float = 1e-3) -> Array:
    """df/dt at t = 0: leaves rounding, 1e-16/step times the size of f, and nothing of a motion that takes seconds."""
    terms = [w * (f(k * step) - f(-k * step)) / step for k, w in enumerate(DIFFERENCE, start=1)]
    return np.asarray(np.sum(terms, axis=0))
