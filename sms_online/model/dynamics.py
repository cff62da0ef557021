"""The equations of motion for given parameter values, H v̇ + C = Q, (40)."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sms_online.model.effect import Inputs
from sms_online.model.flexible import ShapeRate
from sms_online.model.inertia import BodyTerm, LinkMotion, LinkTerm, convective
from sms_online.model.projection import project
from sms_online.model.springs import Spring
from sms_online.stream import Array

if TYPE_CHECKING:
    from sms_online.model.model import Model


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
        return H, C - self.effect_force(x, v, inputs)

    def momentum_and_force(self, x: Array, v: Array, inputs: Inputs | None = None) -> tuple[Array, Array]:
        """P π and G π (B, n_v) of `Model.momentum_columns`, without the columns."""
        model = self.model
        configuration = model.chain.configure(x)
        shape_rates = configuration.shape_rates(v)
        loads = []
        for term, p, g in model.loads(configuration, v, shape_rates, self._bodies):
            pi = self.pi[list(term.parameters), None] if isinstance(term, LinkTerm) else np.ones((1, 1))
            loads.append((term, 0, p @ pi, g @ pi))
        p, g = project(configuration, v, shape_rates, loads, 1)[..., 0]
        return p, g + self.spring_force(x, v) + self.effect_force(x, v, inputs)

    def spring_force(self, x: Array, v: Array) -> Array:
        """Generalized forces (B, n_v) of springs and dampers."""
        return -(self.model._spring_coordinates(x) @ self.stiffness + v @ self.damping)

    def effect_force(self, x: Array, v: Array, inputs: Inputs | None = None) -> Array:
        """Generalized forces (B, n_v) of the effects."""
        out = np.zeros_like(v)
        for effect, columns, own in self.model.acting(inputs):
            out += effect.force(self.model.layout, x, v, own) @ self.pi[columns]
        return out

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
