"""The planar free-flying arm of a system file in MuJoCo: a second engine, which shares no equation with the model.

Every flexible link is a chain of rigid segments on hinge springs, every motor a rotor of its own behind its gear. The
spacecraft moves on two slides and a hinge; there is no gravity, no contact and no damping but what is described.

Discretisation of a link of length L in n cells of L/n, a multiple of its markers: the curvature of a cell sits in two
hinges at its Gauss points, each with the stiffness EI over half the cell. Angles ∫ κ ds, deflections ∫ κ (L - s) ds and
the mean deflection of a cell are then Gauss sums: at the ends of cells, where the markers are, static deflections under
a load at the tip are exact and frequencies converge at fourth order. (One hinge in the middle of each cell is of second
order; with 20 segments its second frequency is 0.5 % off, here 0.06 %.) Finite bending is of second order: a segment of
length l reaches (l κ)²/24 further than its arc, 1e-5 of itself at 0.3 rad. The first three cells are merged into one,
for the segment at the root turns with the joint, whose damper makes on that segment's inertia the fastest pole: without
merging, on a 27th of that inertia.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from sms_online.description.bodies import FlexibleLink
from sms_online.description.schema import System
from sms_online.stream import Array, Block
from sms_sim.sensors import Sensors

# Cells of a link: 12 are 21 segments.
CELLS = 12
# Cells at the root that are one.
MERGED = 3
# With 12 cells the fastest pole is at -2.5e4 1/s and the highest frequency at 2.1e4 rad/s; Runge–Kutta of order four is
# stable to 2.8 over these.
STEP = 1e-4  # s
# Dampers in a link's hinges make poles at -η ω², too fast for an explicit method. The engine's implicit method is of
# first order, so two runs, one with half the step, are extrapolated to second order. It is stable to 2 over the highest
# frequency.
IMPLICIT_STEP = 5e-5  # s
# Share of a motor's mass that turns with its rotor; both lie on the axis, so that the motion does not depend on it.
ROTOR_SHARE = 0.5


@dataclass(frozen=True)
class EngineEffects:
    """What the description does not say, each with the engine's own means; SI units.

    coulomb: friction torque after the gear of each joint, N m. cubic: of the spring torque k δ + k_3 δ³ of each joint,
    N m/rad³. tip_mass: point mass at the end of the last link, kg. link_damping: η, s; every hinge of a link has a
    damper of η times its stiffness.
    """

    coulomb: tuple[float, ...] = ()
    cubic: tuple[float, ...] = ()
    tip_mass: float = 0.0
    link_damping: float = 0.0


@dataclass(frozen=True)
class Motion:
    """Engine states at B instants.

    t (B,) s; qpos, qvel (B, dofs) in the engine's order; torque (B, joints): at the motor shafts, N m.
    """

    t: Array
    qpos: Array
    qvel: Array
    torque: Array

    def rows(self, chosen: slice) -> Motion:
        """The same at some of the instants."""
        return Motion(self.t[chosen], self.qpos[chosen], self.qvel[chosen], self.torque[chosen])


class EngineArm:
    """A described arm as an engine model, `effects` added; step: of its integrator, s.

    Its joints are `base_x`, `base_y`, `base_turn`, and for each link i `rotor_i` (shaft angle), `joint_i`, `link_i_k`.
    """

    def __init__(self, system: System, cells: int, effects: EngineEffects, step: float) -> None:
        self.system = system
        self.cells = cells
        spec = _empty(step)
        if effects.link_damping:
            spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        if effects.coulomb:
            # Friction is one constraint a joint: solved in the space of the constraints it costs half as much.
            spec.option.solver = mujoco.mjtSolver.mjSOL_PGS
        else:
            spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        craft = system.spacecraft
        assert craft is not None
        tracked = np.array(craft.tracked_point)
        base = spec.worldbody.add_body(name="base")
        _give_inertia(base, craft.mass, np.array(craft.center_of_mass) - tracked, craft.inertia.zz)
        base.add_joint(name="base_x", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(1, 0, 0))
        base.add_joint(name="base_y", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0, 1, 0))
        _add_hinge(base, "base_turn")
        parent, end = base, -tracked
        for i, (joint, motor, link) in enumerate(zip(system.joints, system.motors, system.links, strict=True), start=1):
            assert motor is not None
            assert isinstance(link, FlexibleLink)
            stator = parent.add_body(pos=end)
            _give_inertia(stator, (1.0 - ROTOR_SHARE) * motor.mass, np.zeros(3), motor.stator_inertia.zz)
            rotor = parent.add_body(pos=end)
            _give_inertia(rotor, ROTOR_SHARE * motor.mass, np.zeros(3), motor.rotor_inertia)
            shaft = _add_hinge(rotor, f"rotor_{i}")
            if effects.coulomb:
                shaft.frictionloss = effects.coulomb[i - 1] / joint.gear_ratio
            spec.add_actuator(target=f"rotor_{i}", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
            root = parent.add_body(name=f"link_{i}", pos=end)
            _add_hinge(root, f"joint_{i}")
            # The flexible transmission acts on θ_m - q, θ_m being the shaft angle over n.
            transmission = spec.add_tendon(springlength=(0.0, 0.0))
            transmission.wrap_joint(f"rotor_{i}", 1.0 / joint.gear_ratio)
            transmission.wrap_joint(f"joint_{i}", -1.0)
            cubic = effects.cubic[i - 1] if effects.cubic else 0.0
            transmission.stiffness = np.array([joint.stiffness, 0.0, cubic])
            transmission.damping = np.array([joint.damping, 0.0, 0.0])
            parent, end = _add_segments(root, f"link_{i}", link, cells, effects.link_damping)
        if effects.tip_mass:
            _give_inertia(parent.add_body(pos=end), effects.tip_mass, np.zeros(3), 0.0)
        self.model = spec.compile()

    def dof(self, *names: str) -> NDArray[np.intp]:
        """Indices of joints by name, the same in qpos and qvel: every joint here has one degree of freedom."""
        return np.array([self.model.joint(name).id for name in names])

    def joint_dofs(self, kind: str) -> NDArray[np.intp]:
        """Indices of `joint_i` or `rotor_i`."""
        return self.dof(*(f"{kind}_{i}" for i in range(1, len(self.system.joints) + 1)))

    def run(self, duration: float, every: int) -> Motion:
        """The closed loop from rest over `duration` s, one state in `every` steps.

        The torque is held over a step, at what n τ = K_p (q_d - q) + K_D (q̇_d - q̇) will be in its middle. Its value at
        an instant is the mean of the steps on either side, so that integrals over samples are those of what was
        applied. Raises ArithmeticError where the engine warns that the motion is unstable.
        """
        model, system = self.model, self.system
        data = mujoco.MjData(model)
        assert system.controller is not None
        step = model.opt.timestep
        steps = round(duration / step)
        gears = np.array([joint.gear_ratio for joint in system.joints])
        K_p, K_D = np.array(system.controller.stiffness) / gears, np.array(system.controller.damping) / gears
        q_d, q_d_dot = _reference(system, (np.arange(steps + 1) + 0.5) * step)
        demand = (K_p * q_d + K_D * q_d_dot).tolist()
        gains = list(zip(self.joint_dofs("joint").tolist(), K_p.tolist(), K_D.tolist(), strict=True))
        states = np.empty((steps // every + 1, 2, model.nv))
        torque = np.empty((steps // every + 1, gears.size))
        qpos, qvel, ctrl = data.qpos, data.qvel, data.ctrl
        held = [0.0] * gears.size
        before = [0.0] * gears.size
        # Floats one by one: arrays of two cost more than the rest of the loop.
        for k in range(steps + 1):
            previous = held
            speeds = [float(qvel[dof]) for dof, _, _ in gains]
            held = [
                wanted - p * (float(qpos[dof]) + 0.5 * step * speed) - d * (1.5 * speed - 0.5 * last)
                for wanted, (dof, p, d), speed, last in zip(demand[k], gains, speeds, before, strict=True)
            ]
            before = speeds
            if k % every == 0:
                states[k // every, 0], states[k // every, 1] = qpos, qvel
                torque[k // every] = held if k == 0 else [0.5 * (a + b) for a, b in zip(previous, held, strict=True)]
            ctrl[:] = held
            mujoco.mj_step(model, data)
        if any(warning.number for warning in data.warning):
            raise ArithmeticError(f"a step of {step:g} s is unstable with {self.cells} cells")
        return Motion(np.arange(torque.shape[0]) * every * step, states[:, 0], states[:, 1], torque)

    def energy(self, motion: Motion) -> Array:
        """Kinetic energy and that of all springs (B,), J."""
        out = np.empty(motion.t.size)
        for k, data in enumerate(self._visit(motion)):
            mujoco.mj_energyPos(self.model, data)
            mujoco.mj_energyVel(self.model, data)
            out[k] = data.energy.sum()
        return out

    def momentum(self, motion: Motion) -> Array:
        """Momentum of the whole system along x and y, kg m/s, and about the inertial origin, kg m²/s: (B, 3)."""
        base = self.model.body("base").id
        out = np.empty((motion.t.size, 3))
        for row, data in zip(out, self._visit(motion), strict=True):
            mujoco.mj_subtreeVel(self.model, data)
            p = self.model.body_subtreemass[base] * data.subtree_linvel[base]
            row[:2] = p[:2]
            row[2] = (data.subtree_angmom[base] + np.cross(data.subtree_com[base], p))[2]
        return out

    def _visit(self, motion: Motion) -> Iterator[mujoco.MjData]:
        """The engine's quantities at each state in turn."""
        data = mujoco.MjData(self.model)
        for qpos, qvel in zip(motion.qpos, motion.qvel, strict=True):
            data.qpos, data.qvel = qpos, qvel
            mujoco.mj_forward(self.model, data)
            yield data

    def block(self, motion: Motion) -> Block:
        """What exact sensors read: drives, base, joints, and the markers in their links' frames."""
        gears = np.array([joint.gear_ratio for joint in self.system.joints])
        names = [f"tau_{i}" for i in range(1, gears.size + 1)]
        columns = [motion.torque]
        for channels, dofs, scale in (
            (["r_S_x", "r_S_y", "theta_0"], self.dof("base_x", "base_y", "base_turn"), 1.0),
            ([f"q_{i}" for i in range(1, gears.size + 1)], self.joint_dofs("joint"), 1.0),
            ([f"theta_m_{i}" for i in range(1, gears.size + 1)], self.joint_dofs("rotor"), 1.0 / gears),
        ):
            names += channels
            columns.append(motion.qpos[:, dofs] * scale)
        markers = [
            (f"link_{i}", f"link_{i}.marker_{j}")
            for i, link in enumerate(self.system.links, start=1)
            if isinstance(link, FlexibleLink)
            for j in range(1, link.elements + 1)
        ]
        for _, marker in markers:
            names += [f"{marker}.u_y", f"{marker}.theta_z"]
        readings = np.empty((motion.t.size, 2 * len(markers)))
        for row, data in zip(readings, self._visit(motion), strict=True):
            for k, (link, marker) in enumerate(markers):
                root, site = data.body(link), data.site(marker)
                frame = root.xmat.reshape(3, 3)
                row[2 * k] = frame[:, 1] @ (site.xpos - root.xpos)
                tangent = site.xmat.reshape(3, 3)[:, 0] @ frame
                row[2 * k + 1] = np.arctan2(tangent[1], tangent[0])
        return Block(motion.t, tuple(names), np.concatenate((*columns, readings), axis=1))


def cantilever(link: FlexibleLink, cells: int) -> mujoco.MjModel:
    """One link alone, its root clamped."""
    spec = _empty(STEP)
    _add_segments(spec.worldbody.add_body(name="link"), "link", link, cells, 0.0)
    return spec.compile()


def mujoco_capture(
    system: System,
    duration: float,
    cells: int = CELLS,
    effects: EngineEffects = EngineEffects(),
    step: float | None = None,
) -> Block:
    """The arm along its own trajectory from rest, `duration` s, as a noise-free capture at the system's sample rate.

    step: s, of which the sample period is a multiple; by default what 12 cells allow.
    """
    if step is None:
        step = IMPLICIT_STEP if effects.link_damping else STEP
    every = round(1.0 / (system.sample_rate * step))
    arm = EngineArm(system, cells, effects, step)
    motion = arm.run(duration, every)
    if effects.link_damping:
        fine = EngineArm(system, cells, effects, 0.5 * step).run(duration, 2 * every)
        motion = Motion(
            motion.t, 2.0 * fine.qpos - motion.qpos, 2.0 * fine.qvel - motion.qvel, 2.0 * fine.torque - motion.torque
        )
    return arm.block(motion)


def with_noise(block: Block, system: System, grade: str, seed: int) -> Block:
    """The same capture as sensors of a noise grade read it."""
    sensors = Sensors(system, block.channels, grade, seed)
    columns = [block.channels.index(channel) for channel in sensors.channels]
    return Block(block.t, sensors.channels, sensors.read(0, block.values[:, columns]))


def _empty(step: float) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.option.timestep = step
    spec.option.gravity = np.zeros(3)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return spec


def _add_hinge(body: mujoco.MjsBody, name: str) -> mujoco.MjsJoint:
    return body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 0, 1))


def _give_inertia(body: mujoco.MjsBody, mass: float, center: Array, inertia: float) -> None:
    """A flat body: about the axes of the plane, which nothing turns about, half the inertia each."""
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = mass, center, inertia * np.array([0.5, 0.5, 1.0])


def _hinges(length: float, cells: int) -> tuple[Array, Array]:
    """Positions along a link and share of its length, m, of the hinges: two at the Gauss points of each cell."""
    edges = np.append(0.0, length * np.arange(MERGED, cells + 1) / cells)
    width = np.diff(edges)[:, None]
    points = edges[:-1, None] + width * (0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0))
    return points.ravel(), np.repeat(0.5 * width, 2)


def _add_segments(
    root: mujoco.MjsBody, name: str, link: FlexibleLink, cells: int, damping: float
) -> tuple[mujoco.MjsBody, Array]:
    """Fill a link's root body and hang the others on it; the last body and the link's end in its frame."""
    if cells % link.elements or cells // link.elements < MERGED:
        raise ValueError(f"{cells} cells: a multiple of {link.elements} markers, {MERGED} or more of each")
    hinges, shares = _hinges(link.length, cells)
    starts, ends = np.append(0.0, hinges), np.append(hinges, link.length)
    markers = link.length * np.arange(1, link.elements + 1) / link.elements
    body = root
    for k, (start, stop) in enumerate(zip(starts, ends, strict=True)):
        if k > 0:
            body = body.add_body(pos=(start - starts[k - 1], 0.0, 0.0))
            hinge = _add_hinge(body, f"{name}_{k}")
            stiffness = link.flexural_rigidity_z / shares[k - 1]
            hinge.stiffness = np.array([stiffness, 0.0, 0.0])
            hinge.damping = np.array([damping * stiffness, 0.0, 0.0])
        mass = link.mass_per_length * (stop - start)
        _give_inertia(body, mass, np.array([0.5 * (stop - start), 0.0, 0.0]), mass * (stop - start) ** 2 / 12.0)
        for j, s in enumerate(markers, start=1):
            if start < s <= stop:
                body.add_site(name=f"{name}.marker_{j}", pos=(s - start, 0.0, 0.0))
    return body, np.array([ends[-1] - starts[-1], 0.0, 0.0])


def _reference(system: System, t: Array) -> tuple[Array, Array]:
    """q_d and q̇_d (B, joints) at instants t (B,): (46)."""
    assert system.trajectory is not None
    q_d, q_d_dot = np.zeros((2, t.size, len(system.joints)))
    for i, series in enumerate(system.trajectory.joints):
        for harmonic in series:
            w = harmonic.frequency
            q_d[:, i] += harmonic.sine * np.sin(w * t) + harmonic.cosine * (np.cos(w * t) - 1.0)
            q_d_dot[:, i] += w * (harmonic.sine * np.cos(w * t) - harmonic.cosine * np.sin(w * t))
    return q_d, q_d_dot
