"""The model of a described system: energies, powers, momenta and forces as columns, one for each parameter of π.

One set of kinetic terms serves the energy balance (43), (44), the weak form of (33)–(37) and the equations of motion (40).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sms_online.description.schema import FlexibleLink, RigidLink, System
from sms_online.effects.catalogue import build_effects
from sms_online.model.chain import Chain, Configuration
from sms_online.model.flexible import ShapeRate
from sms_online.model.inertia import BodyTerm, LinkMotion, LinkTerm, Term
from sms_online.model.layout import Layout, build_layout
from sms_online.model.parameters import InertialParameter, Parameter, motor, rigid_body, rigidity_parameter
from sms_online.stream import Array


@dataclass(frozen=True)
class Spring:
    """A quadratic potential ½ c zᵀ S z (or dissipation of the rates) on some speeds: parameter index, (n_v, n_v) matrix S."""

    parameter: int
    matrix: Array


class Model:
    """A system's model. Constant: all methods are functions of positions x (B, n_x) and speeds v (B, n_v), SI units."""

    def __init__(self, system: System) -> None:
        self.system = system
        self.layout: Layout = build_layout(system)
        self.chain = Chain(system, self.layout)
        self.gravity = np.array(system.gravity)
        self.effects = build_effects(system)
        parameters: list[Parameter] = []
        self.bodies: list[BodyTerm] = []
        self.links: list[LinkTerm] = []
        self.springs: list[Spring] = []
        self.dampers: list[Spring] = []
        self._add_bodies(parameters)
        self._add_links(parameters)
        self._add_springs(parameters)
        self.effect_slices: list[slice] = []
        for effect in self.effects:
            self.effect_slices.append(slice(len(parameters), len(parameters) + len(effect.parameters)))
            parameters += effect.parameters
        self.parameters = tuple(parameters)
        self.nominal = np.array([p.nominal for p in parameters])

    def _add_bodies(self, parameters: list[Parameter]) -> None:
        system, planar = self.system, self.layout.planar
        none = slice(0, 0)

        def add(inertial: list[InertialParameter], frame: int, speeds: slice) -> None:
            indices = tuple(range(len(parameters), len(parameters) + len(inertial)))
            parameters.extend(p.parameter for p in inertial)
            self.bodies.append(BodyTerm(frame, speeds, indices, np.stack([p.matrix for p in inertial])))

        if system.spacecraft is not None:
            add(rigid_body("spacecraft", "0", system.spacecraft, planar, spacecraft=True), 0, none)
        groups: dict[int, dict[str, list[InertialParameter]]] = {}
        for i in range(1, len(system.joints) + 1):
            for group, inertial in motor(i, system):
                groups.setdefault(i, {}).setdefault(group, []).append(inertial)
        motor_speed = {i: slice(self.layout.theta_m[i - 1], self.layout.theta_m[i - 1] + 1) for i in groups}
        for i, group in groups.items():
            add(group["rotor"], 2 * i - 1, motor_speed[i])
        for i, group in groups.items():
            add(group["stator"] + group["mass"], 2 * i - 1, motor_speed[i])
        for i, link in enumerate(system.links, start=1):
            if isinstance(link, RigidLink):
                add(rigid_body(f"link_{i}", str(i), link, planar, spacecraft=False), 2 * i, none)
        if system.payload is not None:
            frame = 2 * len(system.joints) + 1
            add(rigid_body("payload", "p", system.payload, planar, spacecraft=False), frame, none)

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
                full = np.zeros((self.layout.n_v, self.layout.n_v))
                full[self.layout.q_f[i - 1], self.layout.q_f[i - 1]] = matrix
                self.springs.append(Spring(len(parameters), full))
                parameters.append(rigidity_parameter(i, rigidity, link, self.layout.planar))

    def _add_springs(self, parameters: list[Parameter]) -> None:
        flexible = [(i, joint) for i, joint in enumerate(self.system.joints, start=1) if joint.transmission == "flexible"]
        for kind, symbol, springs in (("stiffness", "k", self.springs), ("damping", "b", self.dampers)):
            for i, joint in flexible:
                unit = ("N/m" if joint.kind == "prismatic" else "N m/rad") if kind == "stiffness" else (
                    "N s/m" if joint.kind == "prismatic" else "N m s/rad"
                )
                delta = np.zeros(self.layout.n_v)
                delta[self.layout.theta_m[i - 1]], delta[self.layout.q[i - 1]] = 1.0, -1.0
                springs.append(Spring(len(parameters), np.outer(delta, delta)))
                parameters.append(Parameter(f"joint_{i}.{kind}", f"{symbol}_{i}", unit, getattr(joint, kind)))

    @property
    def n_pi(self) -> int:
        """Number of physical parameters, effects included."""
        return len(self.parameters)

    def position_rate(self, x: Array, v: Array) -> Array:
        """ẋ (B, n_x)."""
        return self.layout.position_rate(x, v)

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
        twists = configuration.twists(rates)
        for body in self.bodies:
            nu = body.local(twists, rates)[..., 0]
            Y[:, body.parameters] = 0.5 * np.einsum("bnd,bd->bn", body.momentum(nu), nu)
        for link in self.links:
            nu = link.local(twists, rates)[..., 0]
            Y[:, link.parameters] = LinkMotion(link, configuration).energy(nu)
        if self.gravity.any():
            self._add_gravity_potential(Y, configuration)
        z = self._spring_coordinates(x)
        for spring in self.springs:
            Y[:, spring.parameter] = 0.5 * np.einsum("bi,bi->b", z @ spring.matrix, z)
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
            shape = configuration.shapes[link.link]
            assert shape is not None
            center = np.einsum("g,bgi->bi", link.weights, shape.points)
            weight = link.weights.sum() * (frame.origin @ g) + np.einsum("bi,bi->b", center, g @ frame.rotation)
            Y[:, link.parameters[0]] -= weight

    def power_columns(self, x: Array, v: Array) -> Array:
        """Columns (B, n_pi) of dissipated power, (24), and of the power that the effects take out, W per unit."""
        D = np.zeros((x.shape[0], self.n_pi))
        for damper in self.dampers:
            D[:, damper.parameter] = np.einsum("bi,bi->b", v @ damper.matrix, v)
        for effect, columns in zip(self.effects, self.effect_slices, strict=True):
            D[:, columns] = -np.einsum("bvn,bv->bn", effect.force(self.layout, x, v), v)
        return D

    def momentum_columns(self, x: Array, v: Array) -> tuple[Array, Array]:
        """P and G (B, n_v, n_pi) of the equations of motion d/dt(P π) - G π = Q, (33)–(38), without accelerations.

        P = ∂K/∂v. G collects ∂K/∂x, gravity, springs, dampers and effects. Rows of the base are those of S.
        """
        B, n_v = x.shape[0], self.layout.n_v
        P, G = np.zeros((B, n_v, self.n_pi)), np.zeros((B, n_v, self.n_pi))
        configuration = self.chain.configure(x)
        shape_rates = configuration.shape_rates(v)
        eye, none = np.eye(n_v)[None], np.zeros((1, n_v, n_v))
        J = configuration.jacobians
        J_dot = configuration.twist_rates(eye, J, v, shape_rates)

        def add(term: Term, p: Array, g: Array) -> None:
            W, W_dot = term.local(J, eye), term.local(J_dot, none)
            P[:, :, term.parameters] = W.transpose(0, 2, 1) @ p.transpose(0, 2, 1)
            G[:, :, term.parameters] = W_dot.transpose(0, 2, 1) @ p.transpose(0, 2, 1)
            G[:, :, term.parameters] += W.transpose(0, 2, 1) @ g.transpose(0, 2, 1)

        for body in self.bodies:
            nu = (body.local(J, eye) @ v[..., None])[..., 0]
            p = body.momentum(nu)
            g = body.convective(nu, p)
            if self.gravity.any():
                g += body.momentum(self._fall(configuration, body))
            add(body, p, g)
        for link in self.links:
            nu = (link.local(J, eye) @ v[..., None])[..., 0]
            motion = LinkMotion(link, configuration)
            rate = shape_rates[link.link]
            assert rate is not None
            g = motion.convective(nu, rate)
            if self.gravity.any():
                g += motion.momentum(self._fall(configuration, link))
            add(link, motion.momentum(nu), g)
        self._add_forces(G, x, v)
        return P, G

    def _fall(self, configuration: Configuration, term: Term) -> Array:
        """Local speeds (B, d) of free fall: the gravity vector in the frame's axes."""
        local = self.gravity @ configuration.frames[term.frame].rotation
        fall = np.zeros((configuration.size, 6 + term.speeds.stop - term.speeds.start))
        fall[:, :3] = local
        return fall

    def _add_forces(self, G: Array, x: Array, v: Array) -> None:
        z = self._spring_coordinates(x)
        for spring in self.springs:
            G[:, :, spring.parameter] -= z @ spring.matrix
        for damper in self.dampers:
            G[:, :, damper.parameter] -= v @ damper.matrix
        for effect, columns in zip(self.effects, self.effect_slices, strict=True):
            G[:, :, columns] += effect.force(self.layout, x, v)

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
        n_v = self.model.layout.n_v
        return sum((self.pi[s.parameter] * s.matrix for s in self.model.springs), start=np.zeros((n_v, n_v)))

    @cached_property
    def damping(self) -> Array:
        """Damping of the joints (n_v, n_v)."""
        n_v = self.model.layout.n_v
        return sum((self.pi[s.parameter] * s.matrix for s in self.model.dampers), start=np.zeros((n_v, n_v)))

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

    def mass_and_bias(self, x: Array, v: Array) -> tuple[Array, Array]:
        """H (B, n_v, n_v) and C (B, n_v): Coriolis and centrifugal, gravity, springs, dampers, effects."""
        model = self.model
        configuration = model.chain.configure(x)
        shape_rates: list[ShapeRate | None] = configuration.shape_rates(v)
        J, rates = configuration.jacobians, v[..., None]
        velocities = [W @ rates for W in J]
        bias = configuration.twist_rates(rates, velocities, v, shape_rates)
        if model.gravity.any():
            for acceleration, frame in zip(bias, configuration.frames, strict=True):
                acceleration[:, :3, 0] -= model.gravity @ frame.rotation
        none = np.zeros_like(rates)
        H = np.zeros((x.shape[0], model.layout.n_v, model.layout.n_v))
        z = model._spring_coordinates(x)
        C = z @ self.stiffness + v @ self.damping
        for body in self._bodies:
            W = body.local(J, self._eye)
            nu = body.local(velocities, rates)[..., 0]
            M = body.matrices[0]
            H += W.transpose(0, 2, 1) @ (M @ W)
            force = body.local(bias, none)[..., 0] @ M - body.convective(nu, (nu @ M)[:, None])[:, 0]
            C += (force[:, None, :] @ W)[:, 0]
        for link in model.links:
            W = link.local(J, self._eye)
            nu = link.local(velocities, rates)[..., 0]
            motion = LinkMotion(link, configuration)
            pi = self.pi[list(link.parameters)]
            M = motion.mass_matrix(pi)
            H += W.transpose(0, 2, 1) @ (M @ W)
            rate = shape_rates[link.link]
            assert rate is not None
            force = (M @ link.local(bias, none))[..., 0] + np.einsum("n,bnd->bd", pi, motion.bias_force(nu, rate))
            C += (force[:, None, :] @ W)[:, 0]
        for effect, columns in zip(model.effects, model.effect_slices, strict=True):
            C -= effect.force(model.layout, x, v) @ self.pi[columns]
        return H, C

    def acceleration(self, x: Array, v: Array, Q: Array) -> Array:
        """v̇ (B, n_v) under generalized forces Q (B, n_v)."""
        H, C = self.mass_and_bias(x, v)
        return np.asarray(np.linalg.solve(H, (Q - C)[..., None])[..., 0])

    def energy(self, x: Array, v: Array) -> Array:
        """K + U (B,), J."""
        return self.model.energy_columns(x, v) @ self.pi

    def dissipation_power(self, x: Array, v: Array) -> Array:
        """Power that dampers and effects take out (B,), W."""
        return self.model.power_columns(x, v) @ self.pi

    def base_momentum(self, x: Array, v: Array) -> Array:
        """Momentum of the whole system conjugate to the base's speeds (B, n_base): inertial, angular part about S."""
        P, _ = self.model.momentum_columns(x, v)
        return P[:, : self.model.layout.n_base_speeds] @ self.pi
