"""The model of a described system: energies, powers, momenta and forces as columns, one for each parameter of π.

One set of kinetic terms serves the energy balance (43), (44), the weak form of (33)–(37) and the equations of motion
(40).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from sms_online.description.bodies import FlexibleLink, RigidLink
from sms_online.description.channels import wrench_channels
from sms_online.description.schema import System
from sms_online.model.chain import Chain, Configuration
from sms_online.model.dynamics import Dynamics
from sms_online.model.effect import EffectsOf, ForceEffect, InertiaEffect, Inputs
from sms_online.model.flexible import ShapeRate
from sms_online.model.inertia import BodyTerm, LinkMotion, LinkTerm, Term, convective
from sms_online.model.layout import Layout, build_layout
from sms_online.model.parameters import (
    InertialParameter,
    Parameter,
    motor,
    rigid_body,
    rigidity_parameter,
    with_fitted,
)
from sms_online.model.projection import project
from sms_online.model.springs import QuadraticForms, Spring
from sms_online.model.wrench import MeasuredWrenches
from sms_online.stream import Array


class Model:
    """A system's model. Constant: all methods are functions of positions x (B, n_x) and speeds v (B, n_v), SI units.

    Some declared effects ask for more, the torques or internal states of their own: `needs_torque`, `n_states`. Methods
    take these as `inputs` and raise ValueError where they are missing.
    """

    def __init__(self, system: System, effects_of: EffectsOf, reference: Array | None = None) -> None:
        """effects_of: makes the effects that the system declares; `sms_online.effects.build.build_model` states it.

        reference: π whose masses `weight` uses, the nominal ones unless given.
        """
        self.system = system
        self._effects_of = effects_of
        self.layout: Layout = build_layout(system)
        self.chain = Chain(system, self.layout)
        self.gravity = np.array(system.gravity)
        self.effects, inertias = effects_of(system, self.chain, self.weight)
        # Measured inputs: n τ of the joints, then components of wrenches. These come before the effects that a system
        # declares, the last of which a search looks at.
        self.wrenches = MeasuredWrenches(system, self.chain) if system.wrenches else None
        self.n_inputs = len(self.layout.q) + len(wrench_channels(system))
        if self.wrenches is not None:
            self.effects = (self.wrenches, *self.effects)
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
        # Frames that something sits in: the last one, at the tip, holds the payload alone.
        self._frames = 1 + max(term.frame for term in (*self.bodies, *self.links))
        self._moving = self.chain.moving(term.frame for term in (*self.bodies, *self.links))
        self._order_kinetic_terms()
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
        self.parameters = with_fitted(parameters, system)
        self.nominal = np.array([p.nominal for p in self.parameters])
        self.reference = self.nominal if reference is None else reference

    def _order_kinetic_terms(self) -> None:
        """Kinetic terms from the tips to the base, the first of each one's columns then, and these columns' places."""
        terms = (*self.bodies, *self.links)
        self._kinetic: list[int] = []
        self._kinetic_order: list[tuple[int, int]] = []
        for k in sorted(range(len(terms)), key=lambda k: self.chain.inwards(terms[k].frame)):
            self._kinetic_order.append((k, len(self._kinetic)))
            self._kinetic += terms[k].parameters

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
            if isinstance(link, RigidLink) and link.kind == "rigid":
                add(rigid_body(f"link_{i}", str(i), link, planar, spacecraft=False), 2 * i, none)
        if system.payload is not None:
            add(rigid_body("payload", "p", system.payload, planar, spacecraft=False), self.chain.tip_frame, none)
        # After the links: a motor that sits on a rigid link is lumped into that link, not the link into the motor.
        for i, (_, stator) in motors.items():
            add(stator, 2 * i - 1, speeds[i])

    def _add_inertia(self, parameters: list[Parameter], effect: InertiaEffect) -> None:
        indices = tuple(range(len(parameters), len(parameters) + len(effect.parameters)))
        parameters += effect.parameters
        for k, body in enumerate(self.bodies):
            if (body.frame, body.speeds) == (effect.frame, effect.speeds):
                joined = np.concatenate((body.matrices, effect.matrices))
                self.bodies[k] = BodyTerm(body.frame, body.speeds, body.parameters + indices, joined)
                return
        self.bodies.append(BodyTerm(effect.frame, effect.speeds, indices, effect.matrices))

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
                ends = [self.layout.q[i - 1]] if joint.passive else [self.layout.theta_m[i - 1], self.layout.q[i - 1]]
                matrix = np.eye(1) if joint.passive else np.array([[1.0, -1.0], [-1.0, 1.0]])
                springs.append(Spring(len(parameters), ends, matrix))
                parameters.append(Parameter(f"joint_{i}.{kind}", f"{symbol}_{i}", unit, getattr(joint, kind)))

    def of_geometry(self, system: System) -> Model:
        """Model of a system that differs from this one's in lengths and directions alone: the same parameters."""
        return Model(system, self._effects_of, self.reference)

    def stacked(self, others: Sequence[Model], repeats: Sequence[int]) -> Model:
        """What moves in this model, with the geometry of others, each at so many positions of a batch.

        Without springs, dampers and effects. The others are `of_geometry`.
        """
        out = copy(self)
        out.chain = self.chain.stacked([other.chain for other in others], repeats)
        out.links = [
            replace(term, weights=link.weights)
            for term in self.links
            if (link := out.chain.flexible[term.link]) is not None
        ]
        out.springs, out.dampers = [], []
        out.gravity = np.repeat([other.gravity for other in others], repeats, axis=0)
        out.effects, out.effect_slices, out.state_slices = (), [], []
        return out

    def of_parameters(self, wanted: Collection[int]) -> Model:
        """This model with the kinetic terms of some parameters of π alone: columns of the other masses are zero."""
        out = copy(self)
        bodies = (body.of_parameters(wanted) for body in self.bodies)
        out.bodies = [body for body in bodies if body.parameters]
        out.links = [link for link in self.links if not set(link.parameters).isdisjoint(wanted)]
        out._order_kinetic_terms()
        return out

    @property
    def dissipative(self) -> list[int]:
        """Parameters that take power out: indices whose column in `power_columns` is not always zero."""
        effects = [k for columns in self.effect_slices for k in range(columns.start, columns.stop)]
        return self._damping.parameters + effects

    @property
    def inertial(self) -> tuple[int, ...]:
        """Which physical parameters have a part in the momenta."""
        return tuple(self._kinetic)

    @property
    def n_pi(self) -> int:
        """Number of physical parameters, effects included."""
        return len(self.parameters)

    def position_rate(self, x: Array, v: Array) -> Array:
        """ẋ (B, n_x)."""
        return self.layout.position_rate(x, v)

    def inputs(self, signals: Array) -> Inputs:
        """Inputs of the effects from signals (B, n_signals): n τ, measured wrenches, then internal states."""
        return Inputs(signals[:, : self.n_inputs], signals[:, self.n_inputs :])

    @property
    def n_signals(self) -> int:
        """Number of measured inputs and of the effects' internal states."""
        return self.n_inputs + self.n_states

    def generalized_force(self, joint_torque: Array) -> Array:
        """Q of (41), (B, n_v), for torques after the gear n τ (B, joints or more), N m (N)."""
        Q = np.zeros((joint_torque.shape[0], self.layout.n_v))
        Q[:, list(self.layout.theta_m)] = joint_torque[:, : len(self.layout.q)]  # of passive joints 0
        return Q

    def input_columns(self, x: Array) -> Array:
        """Generalized forces (B, n_v, n_inputs) of one unit of each measured input, at positions x (B, n_x)."""
        joints = len(self.layout.q)
        out = np.zeros((x.shape[0], self.layout.n_v, self.n_inputs))
        out[:, list(self.layout.theta_m), range(joints)] = 1.0
        if self.wrenches is not None:
            out[:, :, joints:] = self.wrenches.by_component(x)
        return out

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
                raise ValueError(f"{effect.key} needs torques and its internal states")
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
        P, G = (np.zeros((x.shape[0], self.layout.n_v, self.n_pi)) for _ in range(2))
        configuration = self.chain.configure(x)
        self._add_forces(G, x, v, inputs)
        if rows is not None and not self._moving[list(rows)].any():
            # Motor sides of flexible joints alone: no frame moves with them, their momentum is all there is.
            rates = v[:, :, None]
            twists = configuration.twists(rates, self._frames)
            for body in self.bodies:
                P[:, body.speeds, list(body.parameters)] = body.momentum(body.local(twists, rates)[..., 0])[:, 6:]
            return P[:, list(rows)], G[:, list(rows)]
        shape_rates = configuration.shape_rates(v)
        loads = list(self.loads(configuration, v, shape_rates, self.bodies))
        ordered = [(loads[k][0], first, *loads[k][1:]) for k, first in self._kinetic_order]
        kinetic = project(configuration, v, shape_rates, ordered, len(self._kinetic))
        P[:, :, self._kinetic], G[:, :, self._kinetic] = kinetic
        return (P, G) if rows is None else (P[:, list(rows)], G[:, list(rows)])

    def loads(
        self, configuration: Configuration, v: Array, shape_rates: list[ShapeRate | None], bodies: Sequence[BodyTerm]
    ) -> Iterator[tuple[BodyTerm | LinkTerm, Array, Array]]:
        """Momenta p and convective parts g, gravity's force among them, of bodies and then of all links, (B, d, n)."""
        rates = v[:, :, None]
        twists = configuration.twists(rates, self._frames)
        falls = bool(self.gravity.any())
        for body in bodies:
            nu = body.local(twists, rates)[..., 0]
            p = body.momentum(nu)
            g = convective(nu, p)
            if falls:
                g += body.momentum(self._fall(configuration, body, self.gravity))
            yield body, p, g
        for link in self.links:
            nu, rate = link.local(twists, rates)[..., 0], shape_rates[link.link]
            assert rate is not None
            motion = LinkMotion(link, configuration)
            p, g = motion.momentum_and_convective(nu, rate)
            if falls:
                g += motion.momentum(self._fall(configuration, link, self.gravity))
            yield link, p, g

    def _fall(self, configuration: Configuration, term: Term, g: Array) -> Array:
        """Local speeds (B, d) of free fall: gravity g (3,) or (B, 3), in inertial axes, in the frame's."""
        fall = np.zeros((configuration.size, 6 + len(range(self.layout.n_v)[term.speeds])))
        fall[:, :3] = (np.atleast_2d(g)[:, None] @ configuration.frames[term.frame].rotation)[:, 0]
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

    def _add_forces(self, G: Array, x: Array, v: Array, inputs: Inputs | None) -> None:
        for springs, deflection in ((self.springs, self._spring_coordinates(x)), (self.dampers, v)):
            for spring in springs:
                G[:, spring.speeds, spring.parameter] -= deflection[:, spring.speeds] @ spring.matrix
        for effect, columns, own in self.acting(inputs):
            G[:, :, columns] = effect.force(self.layout, x, v, own)

    def dynamics(self, pi: Array) -> Dynamics:
        """Equations of motion for parameter values π (n_pi,): the full dynamics that the paper reconstructs."""
        return Dynamics(self, pi)
