"""The model of a described system: energies, powers, momenta and forces as columns, one for each parameter of π.

One set of kinetic terms serves the energy balance (43), (44), the weak form of (33)–(37) and the equations of motion
(40).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sms_online.description.schema import FlexibleLink, RigidLink, System
from sms_online.effects.base import ForceEffect, Inputs
from sms_online.effects.catalogue import build_effects, with_kinematics
from sms_online.effects.payload import TipPayload
from sms_online.model.chain import Chain, Configuration
from sms_online.model.flexible import ShapeRate
from sms_online.model.inertia import BodyTerm, LinkMotion, LinkTerm, Term, convective
from sms_online.model.layout import Layout, build_layout
from sms_online.model.parameters import InertialParameter, Parameter, motor, rigid_body, rigidity_parameter
from sms_online.stream import Array


@dataclass(frozen=True)
class Spring:
    """A quadratic potential ½ c zᵀ S z of some coordinates z, or a damper of their rates."""

    parameter: int
    speeds: slice | list[int]
    matrix: Array

    def add_to(self, full: Array, factor: float) -> None:
        """Add `factor` S to an (n_v, n_v) matrix."""
        columns = np.arange(full.shape[0])[self.speeds]
        full[np.ix_(columns, columns)] += factor * self.matrix


class QuadraticForms:
    """Several springs (or dampers) at once: ½ zᵀ S z of each is linear in the products of coordinates."""

    def __init__(self, springs: list[Spring], n_v: int) -> None:
        self.parameters = [spring.parameter for spring in springs]
        full = np.zeros((len(springs), n_v, n_v))
        for matrix, spring in zip(full, springs, strict=True):
            spring.add_to(matrix, 0.5)
        # Products that occur in none of them are left out.
        self._first, self._second = np.nonzero(np.any(full != 0.0, axis=0))
        self._weights = full[:, self._first, self._second].T

    def energies(self, z: Array) -> Array:
        """½ zᵀ S z (B, springs) for all coordinates in the order of the speeds (B, n_v)."""
        return np.asarray((z[:, self._first] * z[:, self._second]) @ self._weights)


class Model:
    """A system's model. Constant: all methods are functions of positions x (B, n_x) and speeds v (B, n_v), SI units.

    Some declared effects ask for more, the torques or internal states of their own: `needs_torque`, `n_states`. Methods
    take these as `inputs` and raise ValueError where they are missing.
    """

    def __init__(self, system: System, reference: Array | None = None) -> None:
        """reference: π whose masses the effect table_tilt weighs, the nominal ones unless given."""
        self.system = system = with_kinematics(system)
        self.layout: Layout = build_layout(system)
        self.chain = Chain(system, self.layout)
        self.gravity = np.array(system.gravity)
        self.effects, inertias = build_effects(system, self.chain, self.weight)
        parameters: list[Parameter] = []
        self.bodies: list[BodyTerm] = []
        self.links: list[LinkTerm] = []
        self.springs: list[Spring] = []
        self.dampers: list[Spring] = []
        self._add_bodies(parameters)
        self._add_links(parameters)
        self._add_springs(parameters)
        self._stiffness = QuadraticForms(self.springs, self.layout.n_v)
        self._damping = QuadraticForms(self.dampers, self.layout.n_v)
        for inertia in inertias:
            self._add_inertia(parameters, inertia)
        # Frames that something sits in: the last one, the end of the last link, holds the payload alone.
        self._frames = 1 + max(term.frame for term in (*self.bodies, *self.links))
        # Of each effect, its columns in π and its internal states in `Inputs.states`.
        self.effect_slices: list[slice] = []
        self.state_slices: list[slice] = []
        self.n_states = 0
        for effect in self.effects:
            self.effect_slices.append(slice(len(parameters), len(parameters) + len(effect.parameters)))
            parameters += effect.parameters
            self.state_slices.append(slice(self.n_states, self.n_states + effect.n_states))
            self.n_states += effect.n_states
        self.needs_torque = any(effect.needs_torque for effect in self.effects)
        self.parameters = tuple(parameters)
        self.nominal = np.array([p.nominal for p in parameters])
        self.reference = self.nominal if reference is None else reference

    def _add_bodies(self, parameters: list[Parameter]) -> None:
        system, planar = self.system, self.layout.planar
        none = slice(0, 0)

        def add(inertial: list[InertialParameter], frame: int, speeds: slice) -> None:
            indices = tuple(range(len(parameters), len(parameters) + len(inertial)))
            parameters.extend(p.parameter for p in inertial)
            matrices = np.stack([p.matrix for p in inertial])
            for k, body in enumerate(self.bodies):
                if body.frame == frame:  # a motor's stator joins its rotor: one term a frame
                    joined = np.concatenate((body.matrices, matrices))
                    self.bodies[k] = BodyTerm(frame, speeds, body.parameters + indices, joined)
                    return
            self.bodies.append(BodyTerm(frame, speeds, indices, matrices))

        if system.spacecraft is not None:
            add(rigid_body("spacecraft", "0", system.spacecraft, planar, spacecraft=True), 0, none)
        motors = {i: motor(i, system) for i in range(1, len(system.joints) + 1) if system.motors[i - 1] is not None}
        speeds = {i: slice(self.layout.theta_m[i - 1], self.layout.theta_m[i - 1] + 1) for i in motors}
        for i, (rotor, _) in motors.items():
            add([rotor], 2 * i - 1, speeds[i])
        for i, link in enumerate(system.links, start=1):
            if isinstance(link, RigidLink):
                add(rigid_body(f"link_{i}", str(i), link, planar, spacecraft=False), 2 * i, none)
        if system.payload is not None:
            frame = 2 * len(system.joints) + 1
            add(rigid_body("payload", "p", system.payload, planar, spacecraft=False), frame, none)
        # After the links: a motor that sits on a rigid link is lumped into that link, not the link into the motor.
        for i, (_, stator) in motors.items():
            add(stator, 2 * i - 1, speeds[i])

    def _add_inertia(self, parameters: list[Parameter], effect: TipPayload) -> None:
        indices = tuple(range(len(parameters), len(parameters) + len(effect.parameters)))
        parameters += effect.parameters
        for k, body in enumerate(self.bodies):
            if body.frame == effect.frame:
                joined = np.concatenate((body.matrices, effect.matrices))
                self.bodies[k] = BodyTerm(body.frame, body.speeds, body.parameters + indices, joined)
                return
        self.bodies.append(BodyTerm(effect.frame, slice(0, 0), indices, effect.matrices))

    def _add_links(self, parameters: list[Parameter]) -> None:
        flexible = [(i, link) for i, link in enumerate(self.system.links, start=1) if isinstance(link, FlexibleLink)]
        polar = not self.layout.planar
        for i, link in flexible:
            kinematics = self.chain.flexible[i - 1]
            assert kinematics is not None
            indices = [len(parameters)]
            parameters.append(Parameter(f"link_{i}.mass_per_length", f"ρA_{i}", "kg/m", link.mass_per_length))
            if polar:
                indices.append(len(parameters))
                parameters.append(
                    Parameter(f"link_{i}.polar_inertia_per_length", f"ρI_p{i}", "kg m", link.polar_inertia_per_length)
                )
            term = LinkTerm(2 * i, self.layout.q_f[i - 1], tuple(indices), i - 1, kinematics.weights, polar)
            self.links.append(term)
        for i, link in flexible:
            kinematics = self.chain.flexible[i - 1]
            assert kinematics is not None
            for rigidity, matrix in kinematics.stiffness.items():
                self.springs.append(Spring(len(parameters), self.layout.q_f[i - 1], matrix))
                parameters.append(rigidity_parameter(i, rigidity, link, self.layout.planar))

    def _add_springs(self, parameters: list[Parameter]) -> None:
        flexible = [
            (i, joint) for i, joint in enumerate(self.system.joints, start=1) if joint.transmission == "flexible"
        ]
        for kind, symbol, springs in (("stiffness", "k", self.springs), ("damping", "b", self.dampers)):
            for i, joint in flexible:
                unit = (
                    ("N/m" if joint.kind == "prismatic" else "N m/rad")
                    if kind == "stiffness"
                    else ("N s/m" if joint.kind == "prismatic" else "N m s/rad")
                )
                ends = [self.layout.theta_m[i - 1], self.layout.q[i - 1]]
                springs.append(Spring(len(parameters), ends, np.array([[1.0, -1.0], [-1.0, 1.0]])))
                parameters.append(Parameter(f"joint_{i}.{kind}", f"{symbol}_{i}", unit, getattr(joint, kind)))

    @property
    def dissipative(self) -> list[int]:
        """Parameters that take power out: indices whose column in `power_columns` is not always zero."""
        effects = [k for columns in self.effect_slices for k in range(columns.start, columns.stop)]
        return self._damping.parameters + effects

    @property
    def n_pi(self) -> int:
        """Number of physical parameters, effects included."""
        return len(self.parameters)

    def position_rate(self, x: Array, v: Array) -> Array:
        """ẋ (B, n_x)."""
        return self.layout.position_rate(x, v)

    def inputs(self, joint_torque: Array, joint_torque_rate: Array | None = None) -> Inputs:
        """Inputs of effects without internal states, from n τ (B, joints) and, where it is known, its rate."""
        return Inputs(joint_torque, np.empty((len(joint_torque), 0)), joint_torque_rate)

    def generalized_force(self, joint_torque: Array) -> Array:
        """Q of (41), (B, n_v), for torques after the gear n τ (B, joints), N m (N)."""
        Q = np.zeros((joint_torque.shape[0], self.layout.n_v))
        Q[:, list(self.layout.theta_m)] = joint_torque
        return Q

    def energy_columns(self, x: Array, v: Array) -> Array:
        """Columns (B, n_pi) of K + U, (7), (14), (15), (17), (23), and of the potential of gravity, J per unit."""
        Y = np.zeros((x.shape[0], self.n_pi))
        configuration = self.chain.configure(x)
        rates = v[:, :, None]
        twists = configuration.twists(rates, self._frames)
        for body in self.bodies:
            nu = body.local(twists, rates)[..., 0]
            Y[:, body.parameters] = body.energy(nu)
        for link in self.links:
            nu = link.local(twists, rates)[..., 0]
            Y[:, link.parameters] = LinkMotion(link, configuration).energy(nu)
        if self.gravity.any():
            self._add_gravity_potential(Y, configuration)
        Y[:, self._stiffness.parameters] = self._stiffness.energies(self._spring_coordinates(x))
        return Y

    def _spring_coordinates(self, x: Array) -> Array:
        """Coordinates (B, n_v) in the order of the speeds; the base's, which no spring holds, are zero."""
        z = np.zeros((x.shape[0], self.layout.n_v))
        z[:, self.layout.n_base_speeds :] = self.layout.joint_positions(x)
        return z

    def _add_gravity_potential(self, Y: Array, configuration: Configuration) -> None:
        g = self.gravity
        for body in self.bodies:
            frame = configuration.frames[body.frame]
            local = g @ frame.rotation  # (B, 3)
            mass = body.matrices[:, 0, 0]
            E = body.matrices
            first = np.stack((E[:, 5, 1], E[:, 3, 2], E[:, 4, 0]), axis=1)  # h of the coupling block h×
            Y[:, body.parameters] -= (frame.origin @ g)[:, None] * mass + local @ first.T
        for link in self.links:
            frame = configuration.frames[link.frame]
            shape = configuration.shape(link.link)
            assert shape is not None
            center = np.einsum("g,bgi->bi", link.weights, shape.points)
            weight = link.weights.sum() * (frame.origin @ g) + np.einsum("bi,bi->b", center, g @ frame.rotation)
            Y[:, link.parameters[0]] -= weight

    def power_columns(self, x: Array, v: Array, inputs: Inputs | None = None) -> Array:
        """Columns (B, n_pi) of dissipated power, (24), and of the power that the effects take out, W per unit."""
        D = np.zeros((x.shape[0], self.n_pi))
        D[:, self._damping.parameters] = 2.0 * self._damping.energies(v)
        for effect, columns, own in self.acting(inputs):
            D[:, columns] = effect.power(self.layout, x, v, own)
        return D

    def acting(self, inputs: Inputs | None) -> Iterator[tuple[ForceEffect, slice, Inputs | None]]:
        """Each effect with its columns in π and its own inputs; ValueError where it lacks some."""
        for effect, columns, states in zip(self.effects, self.effect_slices, self.state_slices, strict=True):
            if inputs is None and (effect.needs_torque or effect.n_states):
                raise ValueError(f"{effect.name}@{effect.where} needs torques and its internal states")
            yield effect, columns, None if inputs is None else replace(inputs, states=inputs.states[:, states])

    def state_rate(self, x: Array, v: Array, z: Array) -> Array:
        """ż (B, n_states) of the effects' internal states."""
        rates = [
            effect.state_rate(self.layout, x, v, z[:, states])
            for effect, states in zip(self.effects, self.state_slices, strict=True)
        ]
        return np.concatenate((np.empty((len(z), 0)), *rates), axis=1)

    def initial_state(self, x_0: Array) -> Array:
        """Internal states (n_states,) of the effects at rest at positions x_0 (n_x,)."""
        return np.concatenate((np.empty(0), *(effect.initial_state(self.layout, x_0) for effect in self.effects)))

    def momentum_columns(
        self, x: Array, v: Array, rows: Sequence[int] | None = None, inputs: Inputs | None = None
    ) -> tuple[Array, Array]:
        """P and G (B, rows, n_pi) of the equations of motion d/dt(P π) - G π = Q, (33)–(38), without accelerations.

        P = ∂K/∂v. G collects ∂K/∂x, gravity, springs, dampers and effects. Rows of the base are those of S.
        rows: the speeds whose equations are wanted; all of them by default.
        """
        B, n_v = x.shape[0], self.layout.n_v
        rows = range(n_v) if rows is None else rows
        P, G = np.zeros((B, len(rows), self.n_pi)), np.zeros((B, len(rows), self.n_pi))
        configuration = self.chain.configure(x)
        rates, select, none = v[:, :, None], np.eye(n_v)[None, :, list(rows)], np.zeros((1, n_v, len(rows)))
        twists = configuration.twists(rates, self._frames)
        self._add_forces(P, G, x, v, rows, inputs)
        if not self.chain.moves(self._frames - 1, slice(0, 0))[list(rows)].any():
            # Motor sides of flexible joints alone: no frame moves with them, their momentum is all there is.
            for body in self.bodies:
                for row in np.flatnonzero(np.isin(rows, range(*body.speeds.indices(n_v)))):
                    P[:, row, body.parameters] = body.momentum(body.local(twists, rates)[..., 0])[:, 6]
            return P, G
        shape_rates = configuration.shape_rates(v)
        W = configuration.twists(select)
        W_dot = configuration.twist_rates(select, W, v, shape_rates)

        def add(term: Term, p: Array, g: Array) -> None:
            J, J_dot = term.local(W, select), term.local(W_dot, none)
            P[:, :, term.parameters] = J.transpose(0, 2, 1) @ p
            G[:, :, term.parameters] += J_dot.transpose(0, 2, 1) @ p + J.transpose(0, 2, 1) @ g

        for body in self.bodies:
            if self.chain.moves(body.frame, body.speeds)[list(rows)].any():
                nu = body.local(twists, rates)[..., 0]
                p = body.momentum(nu)
                g = convective(nu, p)
                if self.gravity.any():
                    g += body.momentum(self._fall(configuration, body, self.gravity))
                add(body, p, g)
        for link in self.links:
            if self.chain.moves(link.frame, link.speeds)[list(rows)].any():
                nu = link.local(twists, rates)[..., 0]
                motion = LinkMotion(link, configuration)
                rate = shape_rates[link.link]
                assert rate is not None
                g = motion.convective(nu, rate)
                if self.gravity.any():
                    g += motion.momentum(self._fall(configuration, link, self.gravity))
                add(link, motion.momentum(nu), g)
        return P, G

    def _fall(self, configuration: Configuration, term: Term, g: Array) -> Array:
        """Local speeds (B, d) of free fall: a gravity vector g (3,) in the frame's axes."""
        local = g @ configuration.frames[term.frame].rotation
        fall = np.zeros((configuration.size, 6 + term.speeds.stop - term.speeds.start))
        fall[:, :3] = local
        return fall

    def weight(self, x: Array) -> Array:
        """Generalized forces (B, n_v, 2) of 1 m/s² along inertial x and y on the masses of the reference π."""
        configuration = self.chain.configure(x)
        select = np.eye(self.layout.n_v)[None]
        out = np.zeros((x.shape[0], self.layout.n_v, 2))
        terms: list[BodyTerm | LinkTerm] = [*self.bodies, *self.links]
        for term in terms:
            J = term.local(configuration.jacobians, select)
            pi = self.reference[list(term.parameters)]
            inert = LinkMotion(term, configuration) if isinstance(term, LinkTerm) else term
            for axis, g in enumerate(np.eye(3)[:2]):
                momentum = inert.momentum(self._fall(configuration, term, g)) @ pi
                out[:, :, axis] += np.einsum("bdv,bd->bv", J, momentum)
        return out

    def _add_forces(self, P: Array, G: Array, x: Array, v: Array, rows: Sequence[int], inputs: Inputs | None) -> None:
        place = {speed: row for row, speed in enumerate(rows)}
        for springs, deflection in ((self.springs, self._spring_coordinates(x)), (self.dampers, v)):
            for spring in springs:
                force = deflection[:, spring.speeds] @ spring.matrix
                for k, speed in enumerate(np.arange(self.layout.n_v)[spring.speeds]):
                    if speed in place:
                        G[:, place[speed], spring.parameter] -= force[:, k]
        for effect, columns, own in self.acting(inputs):
            G[:, :, columns] = effect.force(self.layout, x, v, own)[:, list(rows)]
            momentum = effect.momentum(self.layout, x, v, own)
            if momentum is not None:
                P[:, :, columns] = momentum[:, list(rows)]

    def dynamics(self, pi: Array) -> Dynamics:
        """Equations of motion for parameter values π (n_pi,): the full dynamics that the paper reconstructs."""
        return Dynamics(self, pi)


class Dynamics:
    """H v̇ + C = Q, (40), for given parameter values."""

    def __init__(self, model: Model, pi: Array) -> None:
        self.model = model
        self.pi = pi
        self._bodies = [
            BodyTerm(b.frame, b.speeds, (0,), np.tensordot(pi[list(b.parameters)], b.matrices, 1)[None])
            for b in model.bodies
        ]
        self._eye = np.eye(model.layout.n_v)[None]

    @cached_property
    def stiffness(self) -> Array:
        """K_f (n_v, n_v): stiffness of links and joints."""
        return self._assemble(self.model.springs)

    @cached_property
    def damping(self) -> Array:
        """Damping of the joints (n_v, n_v)."""
        return self._assemble(self.model.dampers)

    def _assemble(self, springs: list[Spring]) -> Array:
        full = np.zeros((self.model.layout.n_v, self.model.layout.n_v))
        for spring in springs:
            spring.add_to(full, self.pi[spring.parameter])
        return full

    def mass_matrix(self, x: Array) -> Array:
        """H (B, n_v, n_v)."""
        configuration = self.model.chain.configure(x)
        H = np.zeros((x.shape[0], self.model.layout.n_v, self.model.layout.n_v))
        for body in self._bodies:
            W = body.local(configuration.jacobians, self._eye)
            H += W.transpose(0, 2, 1) @ (body.matrices[0] @ W)
        for link in self.model.links:
            W = link.local(configuration.jacobians, self._eye)
            M = LinkMotion(link, configuration).mass_matrix(self.pi[list(link.parameters)])
            H += W.transpose(0, 2, 1) @ (M @ W)
        return H

    def mass_and_bias(self, x: Array, v: Array, inputs: Inputs | None = None) -> tuple[Array, Array]:
        """H (B, n_v, n_v) and C (B, n_v): Coriolis and centrifugal, gravity, springs, dampers, effects."""
        model = self.model
        configuration = model.chain.configure(x)
        shape_rates: list[ShapeRate | None] = configuration.shape_rates(v)
        J, rates = configuration.jacobians, v[..., None]
        velocities = [W @ rates for W in J]
        bias = configuration.twist_rates(rates, velocities, v, shape_rates)
        if model.gravity.any():
            # Frames that coincide share their arrays, so none is changed in place.
            for k, frame in enumerate(configuration.frames):
                fall = np.zeros_like(bias[k])
                fall[:, :3, 0] = model.gravity @ frame.rotation
                bias[k] = bias[k] - fall
        none = np.zeros_like(rates)
        H = np.zeros((x.shape[0], model.layout.n_v, model.layout.n_v))
        z = model._spring_coordinates(x)
        C = z @ self.stiffness + v @ self.damping
        for body in self._bodies:
            W = body.local(J, self._eye)
            nu = body.local(velocities, rates)[..., 0]
            M = body.matrices[0]
            H += W.transpose(0, 2, 1) @ (M @ W)
            force = M @ body.local(bias, none) - convective(nu, (nu @ M)[..., None])
            C += (W.transpose(0, 2, 1) @ force)[..., 0]
        for link in model.links:
            W = link.local(J, self._eye)
            nu = link.local(velocities, rates)[..., 0]
            motion = LinkMotion(link, configuration)
            pi = self.pi[list(link.parameters)]
            M = motion.mass_matrix(pi)
            H += W.transpose(0, 2, 1) @ (M @ W)
            rate = shape_rates[link.link]
            assert rate is not None
            force = M @ link.local(bias, none) + motion.bias_force(nu, rate) @ pi[:, None]
            C += (W.transpose(0, 2, 1) @ force)[..., 0]
        for effect, columns, own in model.acting(inputs):
            C -= effect.force(model.layout, x, v, own) @ self.pi[columns]
        return H, C

    def momentum_and_force(self, x: Array, v: Array, inputs: Inputs | None = None) -> tuple[Array, Array]:
        """P π and G π (B, n_v) of `Model.momentum_columns`, without the columns."""
        model = self.model
        configuration = model.chain.configure(x)
        shape_rates = configuration.shape_rates(v)
        rates, none = v[:, :, None], np.zeros_like(self._eye)
        velocities = configuration.twists(rates, model._frames)
        W = configuration.jacobians
        W_dot = configuration.twist_rates(self._eye, W, v, shape_rates)
        p = np.zeros_like(v)
        g = -(model._spring_coordinates(x) @ self.stiffness + v @ self.damping)

        def add(term: Term, momentum: Array, force: Array) -> None:
            nonlocal p, g
            J, J_dot = term.local(W, self._eye), term.local(W_dot, none)
            p = p + (momentum.swapaxes(1, 2) @ J)[:, 0]
            g = g + (momentum.swapaxes(1, 2) @ J_dot + force.swapaxes(1, 2) @ J)[:, 0]

        for body in self._bodies:
            nu = body.local(velocities, rates)[..., 0]
            momentum = body.momentum(nu)
            force = convective(nu, momentum)
            if model.gravity.any():
                force = force + body.momentum(model._fall(configuration, body, model.gravity))
            add(body, momentum, force)
        for link in model.links:
            nu = link.local(velocities, rates)[..., 0]
            motion, rate = LinkMotion(link, configuration), shape_rates[link.link]
            assert rate is not None
            pi = self.pi[list(link.parameters), None]
            force = motion.convective(nu, rate) @ pi
            if model.gravity.any():
                force = force + motion.momentum(model._fall(configuration, link, model.gravity)) @ pi
            add(link, motion.momentum(nu) @ pi, force)
        for effect, columns, own in model.acting(inputs):
            g = g + effect.force(model.layout, x, v, own) @ self.pi[columns]
            effect_momentum = effect.momentum(model.layout, x, v, own)
            if effect_momentum is not None:
                p = p + effect_momentum @ self.pi[columns]
        return p, g

    def acceleration(self, x: Array, v: Array, Q: Array, inputs: Inputs | None = None) -> Array:
        """v̇ (B, n_v) under generalized forces Q (B, n_v)."""
        H, C = self.mass_and_bias(x, v, inputs)
        return np.asarray(np.linalg.solve(H, (Q - C)[..., None])[..., 0])

    def energy(self, x: Array, v: Array) -> Array:
        """K + U (B,), J."""
        return self.model.energy_columns(x, v) @ self.pi

    def dissipation_power(self, x: Array, v: Array, inputs: Inputs | None = None) -> Array:
        """Power that dampers and effects take out (B,), W."""
        return self.model.power_columns(x, v, inputs) @ self.pi

    def base_momentum(self, x: Array, v: Array, inputs: Inputs | None = None) -> Array:
        """Momentum of the whole system conjugate to the base's speeds (B, n_base): inertial, angular part about S."""
        P, _ = self.model.momentum_columns(x, v, range(self.model.layout.n_base_speeds), inputs)
        return P @ self.pi
