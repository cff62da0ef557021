"""A spatial tree of flexible and rigid links in MuJoCo, with brackets, fixed and passive joints: see `engine_mujoco`.

Every flexible link is a chain of rigid segments with a hinge for each of its deformations between them. The base moves
on three slides and three hinges, which its small rotations keep clear of their singularity.
"""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from sms_online.description.bodies import FlexibleLink, Inertia, Joint, RigidBody
from sms_online.description.schema import System
from sms_online.stream import Array, Block
from tests.engine_mujoco import MERGED, ROTOR_SHARE, EngineArm, Motion, _empty, _hinges

AXES = np.eye(3)
# What a marker reads in its link's frame, by the deformation that moves it.
READINGS = {
    "u_y": "bending_z", "u_z": "bending_y", "theta_x": "torsion", "theta_y": "bending_y", "theta_z": "bending_z",
}  # fmt: skip
# Steps towards equilibrium, each to a hundredth of the one before; the time step of an engine that is never run, s.
STATIC_STEPS, STATIC_STEP = 12, 1e-4


class EngineTree(EngineArm):
    """A described tree as an engine model; step: of its integrator, s.

    Its joints are `base_x` …, `base_turn_x` …, and for each joint i `joint_i`, and `rotor_i` (shaft angle) if it has a
    motor. Sites: `S`, and for each flexible link `link_i.root`, `link_i.marker_j`.
    """

    def __init__(self, system: System, cells: int, step: float) -> None:
        self.system, self.cells = system, cells
        spec = _empty(step)
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        spec.option.gravity = np.array(system.gravity)
        base = spec.worldbody.add_body(name="base")
        craft = system.spacecraft
        assert craft is not None
        tracked = np.array(craft.tracked_point)
        _add_inertia(base, craft, -tracked)
        for axis, name in zip(AXES, "xyz", strict=True):
            base.add_joint(name=f"base_{name}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        for axis, name in zip(AXES, "xyz", strict=True):
            base.add_joint(name=f"base_turn_{name}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
        ends = {"base": (base, -tracked, Rotation.identity())}
        mounts = (*system.joints, *system.fixed_joints)
        waiting = list(range(1, len(mounts) + 1))
        while waiting:
            i = waiting.pop(0)
            mount, link = mounts[i - 1], system.links[i - 1]
            before = mount.parent or ("base" if i == 1 else f"link_{i - 1}")
            if before not in ends:
                waiting.append(i)
                continue
            parent, end, turn = ends[before]
            place = end + turn.apply(mount.mount_position)
            turn = turn * Rotation.from_rotvec(mount.mount_rotation)
            body = parent.add_body(name=f"link_{i}", pos=place, quat=turn.as_quat(scalar_first=True))
            if isinstance(mount, Joint):
                self._add_joint(spec, i, mount, parent, place, turn, body)
            if isinstance(link, FlexibleLink):
                root = body.add_body(
                    pos=link.root_position,
                    quat=Rotation.from_rotvec(link.root_rotation).as_quat(scalar_first=True),
                )
                last, tip = _add_segments(root, f"link_{i}", link, cells)
                ends[f"link_{i}"] = (last, tip, Rotation.identity())
            else:
                _add_inertia(body.add_body(), link, np.zeros(3))
                ends[f"link_{i}"] = (body, np.array(link.tip), Rotation.identity())
        if system.payload is not None:
            parent, end, turn = ends[f"link_{len(system.joints)}"]
            _add_inertia(parent.add_body(pos=end), system.payload, np.zeros(3))
        self.model = spec.compile()

    def _add_joint(
        self, spec: mujoco.MjSpec, i: int, joint: Joint, parent: mujoco.MjsBody, place: Array, turn: Rotation,
        body: mujoco.MjsBody,
    ) -> None:  # fmt: skip
        hinge = body.add_joint(name=f"joint_{i}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=joint.axis)
        motor = self.system.motors[i - 1]
        if motor is None:
            hinge.stiffness = np.array([joint.stiffness, 0.0, 0.0])
            hinge.damping = np.array([joint.damping, 0.0, 0.0])
            spec.add_actuator(target=f"joint_{i}", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
            return
        turned = turn.as_quat(scalar_first=True)
        stator, rotor = parent.add_body(pos=place, quat=turned), parent.add_body(pos=place, quat=turned)
        # Of a rotor of revolution the transverse inertia is counted with the stator, as described.
        axial = np.outer(joint.axis, joint.axis)
        round_body = motor.rotor_inertia * (axial + 0.5 * (np.eye(3) - axial))
        transverse = 0.5 * motor.rotor_inertia * (np.eye(3) - axial)
        _add_tensor(stator, (1.0 - ROTOR_SHARE) * motor.mass, _tensor(motor.stator_inertia) - transverse)
        _add_tensor(rotor, ROTOR_SHARE * motor.mass, round_body)
        rotor.add_joint(name=f"rotor_{i}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=joint.axis)
        spec.add_actuator(target=f"rotor_{i}", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
        transmission = spec.add_tendon(springlength=(0.0, 0.0))
        transmission.wrap_joint(f"rotor_{i}", 1.0 / joint.gear_ratio)
        transmission.wrap_joint(f"joint_{i}", -1.0)
        transmission.stiffness = np.array([joint.stiffness, 0.0, 0.0])
        transmission.damping = np.array([joint.damping, 0.0, 0.0])

    def block(self, motion: Motion) -> Block:
        """What exact sensors read: drives, base, joints, and the markers in their links' frames."""
        driven = [i for i, joint in enumerate(self.system.joints, start=1) if not joint.passive]
        geared = [i for i in driven if self.system.motors[i - 1] is not None]
        every = range(1, len(self.system.joints) + 1)
        gears = np.array([self.system.joints[i - 1].gear_ratio for i in geared])
        names = [f"tau_{i}" if i in geared else f"force_{i}" for i in driven]
        names += ["r_S_x", "r_S_y", "r_S_z"] + [f"q_{i}" for i in every] + [f"theta_m_{i}" for i in geared]
        columns = [
            motion.torque[:, [i - 1 for i in driven]],
            motion.qpos[:, self.dof("base_x", "base_y", "base_z")],
            motion.qpos[:, self.dof(*(f"joint_{i}" for i in every))],
            motion.qpos[:, self.dof(*(f"rotor_{i}" for i in geared))] / gears,
        ]
        names += ["eta", "eps_x", "eps_y", "eps_z"]
        markers = [
            (f"link_{i}", f"link_{i}.marker_{j}")
            for i, link in enumerate(self.system.links, start=1)
            if isinstance(link, FlexibleLink)
            for j in range(1, link.elements + 1)
        ]
        seen = np.empty((motion.t.size, 4))
        readings = np.empty((motion.t.size, len(markers), len(READINGS)))
        for row, own, data in zip(seen, readings, self._visit(motion), strict=True):
            row[:] = data.body("base").xquat
            for k, (link, marker) in enumerate(markers):
                own[k] = _reading(data, f"{link}.root", marker)
        columns.append(seen)
        for k, (link, marker) in enumerate(markers):
            described = self.system.links[int(link.removeprefix("link_")) - 1]
            assert isinstance(described, FlexibleLink)
            for column, (name, deformation) in zip(readings[:, k].T, READINGS.items(), strict=True):
                if deformation in described.deformations:
                    names.append(f"{marker}.{name}")
                    columns.append(column[:, None])
        return Block(motion.t, tuple(names), np.concatenate(columns, axis=1))


def tree_capture(system: System, duration: float, cells: int, step: float) -> Block:
    """The tree along its own trajectory from rest for `duration` s, as a noise-free capture at the system's rate."""
    arm = EngineTree(system, cells, step)
    return arm.block(arm.run(duration, round(1.0 / (system.sample_rate * step))))


def hanging_end(system: System, cells: int) -> Array:
    """Readings u_y, u_z, θ_x, θ_y, θ_z of a first link's end that hangs at rest from its clamped root.

    Without polar inertia, which would be too large for a body as thin as a fine chain has them.
    """
    spec, link = _empty(STATIC_STEP), system.links[0]
    assert isinstance(link, FlexibleLink)
    spec.option.gravity = np.array(system.gravity)
    _add_segments(spec.worldbody.add_body(), "link", link.model_copy(update={"polar_inertia_per_length": 1e-9}), cells)
    model = spec.compile()
    data = mujoco.MjData(model)
    # What the link weighs hardly depends on its shape: so few steps by its springs alone find that.
    for _ in range(STATIC_STEPS):
        mujoco.mj_forward(model, data)
        left = data.qfrc_passive - data.qfrc_bias
        data.qpos += left / model.jnt_stiffness
    assert np.abs(left).max() < 1e-10
    mujoco.mj_forward(model, data)
    return _reading(data, "link.root", f"link.marker_{link.elements}")


def _reading(data: mujoco.MjData, root: str, marker: str) -> Array:
    """Displacements and rotation vector of a marker in its link's frame: u_y, u_z, θ_x, θ_y, θ_z."""
    start, site = data.site(root), data.site(marker)
    frame = start.xmat.reshape(3, 3)
    turn = Rotation.from_matrix(frame.T @ site.xmat.reshape(3, 3)).as_rotvec()
    return np.append((frame.T @ (site.xpos - start.xpos))[1:], turn)


def _tensor(i: Inertia) -> Array:
    return np.array([[i.xx, i.xy, i.xz], [i.xy, i.yy, i.yz], [i.xz, i.yz, i.zz]])


def _add_inertia(body: mujoco.MjsBody, described: RigidBody, origin: Array) -> None:
    """A described body whose frame's origin lies at `origin` of the engine's body."""
    _add_tensor(body, described.mass, _tensor(described.inertia), origin + np.array(described.center_of_mass))


def _add_tensor(body: mujoco.MjsBody, mass: float, tensor: Array, center: Array | None = None) -> None:
    body.explicitinertial = True
    body.mass = mass
    body.ipos = np.zeros(3) if center is None else center
    body.fullinertia = [tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[0, 2], tensor[1, 2]]


def _add_segments(root: mujoco.MjsBody, name: str, link: FlexibleLink, cells: int) -> tuple[mujoco.MjsBody, Array]:
    """As `engine_mujoco._add_segments`, with hinges about all three axes."""
    if cells % link.elements or cells // link.elements < MERGED:
        raise ValueError(f"{cells} cells: a multiple of {link.elements} markers, {MERGED} or more of each")
    rigidities = {
        "torsion": link.torsional_rigidity,
        "bending_y": link.flexural_rigidity_y,
        "bending_z": link.flexural_rigidity_z,
    }
    hinges, shares = _hinges(link.length, cells)
    starts, ends = np.append(0.0, hinges), np.append(hinges, link.length)
    markers = link.length * np.arange(1, link.elements + 1) / link.elements
    body = root
    root.add_site(name=f"{name}.root")
    for k, (start, stop) in enumerate(zip(starts, ends, strict=True)):
        if k > 0:
            body = body.add_body(pos=(start - starts[k - 1], 0.0, 0.0))
            # Two bends in one order are a twist of half their product: of every other hinge in the other order.
            axes = list(zip(AXES, rigidities.items(), strict=True))
            for axis, (deformation, rigidity) in axes if k % 2 else axes[::-1]:
                if deformation not in link.deformations:
                    continue
                hinge = body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
                hinge.stiffness = np.array([rigidity / shares[k - 1], 0.0, 0.0])
        width = stop - start
        mass, axial = link.mass_per_length * width, link.polar_inertia_per_length * width
        across = mass * width**2 / 12.0
        _add_tensor(body, mass, np.diag([axial, across, across]), np.array([0.5 * width, 0.0, 0.0]))
        for j, s in enumerate(markers, start=1):
            if start < s <= stop:
                body.add_site(name=f"{name}.marker_{j}", pos=(s - start, 0.0, 0.0))
    return body, np.array([ends[-1] - starts[-1], 0.0, 0.0])
