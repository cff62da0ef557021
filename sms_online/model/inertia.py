"""Kinetic terms of the model: bodies of constant inertia and flexible links, each linear in its parameters, (7), (15), (17).

A term sees its local speeds ν (B, d): the twist of its frame, then the rates of d - 6 coordinates of its own. For each of its
parameters it gives the local momentum p = ∂K/∂ν, the convective part g with force F = ṗ - g (Newton–Euler in body axes), and
the force F at ν̇ = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_online.model.chain import Configuration
from sms_online.model.flexible import Shape, ShapeRate
from sms_online.model.so3 import cross, skew
from sms_online.stream import Array


@dataclass(frozen=True)
class Term:
    """Where a kinetic term sits: frame index, the speeds of its own, and the indices of its parameters in π."""

    frame: int
    speeds: slice
    parameters: tuple[int, ...]

    def local(self, twists: list[Array], rates: Array) -> Array:
        """Local speeds (B, d, m) of columns of twists and rates (B or 1, n_v, m)."""
        twist = twists[self.frame]
        own = rates[:, self.speeds]
        if own.shape[1] == 0:
            return twist
        return np.concatenate((twist, np.broadcast_to(own, (twist.shape[0], *own.shape[1:]))), axis=1)


@dataclass(frozen=True)
class BodyTerm(Term):
    """Rigid bodies that share a frame: matrices (n, d, d), one for each parameter."""

    matrices: Array

    def momentum(self, nu: Array) -> Array:
        """p (B, n, d) of each parameter."""
        n, d, _ = self.matrices.shape
        return (nu @ self.matrices.transpose(1, 0, 2).reshape(d, n * d)).reshape(-1, n, d)

    def convective(self, nu: Array, p: Array) -> Array:
        """g (B, n, d) of each parameter for its momentum p."""
        return convective(nu, p)


def convective(nu: Array, p: Array) -> Array:
    """Convective part (B, n, d) of body-axes momenta p (B, n, d) that do not depend on the shape."""
    v, omega = nu[:, None, :3], nu[:, None, 3:6]
    g = np.zeros_like(p)
    g[..., :3] = -cross(omega, p[..., :3])
    g[..., 3:6] = -cross(omega, p[..., 3:6]) - cross(v, p[..., :3])
    return g


@dataclass(frozen=True)
class LinkTerm(Term):
    """A flexible link: mass per length and, in space, polar inertia per length."""

    link: int  # from 0
    weights: Array  # (G,) m
    polar: bool


class LinkMotion:
    """Kinetic quantities of one flexible link at B configurations and, where given, local speeds."""

    def __init__(self, term: LinkTerm, configuration: Configuration) -> None:
        shape = configuration.shapes[term.link]
        assert shape is not None
        self.term = term
        self.shape: Shape = shape
        B, G = configuration.size, term.weights.size
        d = 6 + shape.J.shape[-1]
        self.root = np.sqrt(term.weights)
        # Velocities of the quadrature points are A ν, scaled by the root of the weights: K = ½ ρA |A ν|².
        A = np.zeros((B, G, 3, d))
        A[..., :3] = np.eye(3)
        A[..., 3:6] = -skew(shape.points)
        A[..., 6:] = shape.J
        self.A = (A * self.root[:, None, None]).reshape(B, 3 * G, d)
        if term.polar:
            # Axial spin of the sections is S ν: K = ½ ρI_p |S ν|².
            S = np.zeros((B, G, d))
            S[..., 3:6] = shape.tangent
            S[..., 6:] = _dot(shape.tangent, shape.spin)
            self.S = S * self.root[:, None]

    def energy(self, nu: Array) -> Array:
        """K (B, n) of each parameter."""
        out = [_square(self.A, nu)]
        if self.term.polar:
            out.append(_square(self.S, nu))
        return np.stack(out, axis=1)

    def momentum(self, nu: Array) -> Array:
        """p (B, n, d) of each parameter."""
        out = [_back(self.A, _apply(self.A, nu))]
        if self.term.polar:
            out.append(_back(self.S, _apply(self.S, nu)))
        return np.stack(out, axis=1)

    def mass_matrix(self, pi: Array) -> Array:
        """Local mass matrix (B, d, d) for the term's parameters."""
        M = pi[0] * (self.A.transpose(0, 2, 1) @ self.A)
        if self.term.polar:
            M = M + pi[1] * (self.S.transpose(0, 2, 1) @ self.S)
        return np.asarray(M)

    def _rates(self, nu: Array, rate: ShapeRate) -> tuple[Array, Array]:
        """Ȧ (B, G, 3, d) and the points' velocities u (B, G, 3), both scaled by the root of the weights."""
        B, G = nu.shape[0], self.term.weights.size
        q_f_dot = nu[:, None, 6:, None]
        A_dot = np.zeros((B, G, 3, self.A.shape[2]))
        A_dot[..., 3:6] = -skew((self.shape.J @ q_f_dot)[..., 0])
        A_dot[..., 6:] = rate.J
        return A_dot * self.root[:, None, None], _apply(self.A, nu).reshape(B, G, 3)

    def _polar_rates(self, nu: Array, rate: ShapeRate) -> tuple[Array, Array]:
        """Axial spin y (B, G), and ṫᵀ-free rate of S (B, G, d): t·Ḃ - (ω × t)·B, scaled by the root of the weights."""
        omega = nu[:, None, 3:6]
        turning = cross(omega, np.broadcast_to(self.shape.tangent, (nu.shape[0], *self.shape.tangent.shape[1:])))
        g = np.zeros_like(self.S)
        g[..., 3:6] = -turning
        g[..., 6:] = _dot(self.shape.tangent, rate.spin) - _dot(turning, self.shape.spin)
        return _apply(self.S, nu), g * self.root[:, None]

    def convective(self, nu: Array, rate: ShapeRate) -> Array:
        """g (B, n, d) of each parameter: Ȧᵀ u - Aᵀ (ω × u)."""
        A_dot, u = self._rates(nu, rate)
        flat = u.reshape(u.shape[0], -1)
        turning = cross(nu[:, None, 3:6], u).reshape(flat.shape)
        out = [_back(A_dot.reshape(self.A.shape), flat) - _back(self.A, turning)]
        if self.term.polar:
            y, g = self._polar_rates(nu, rate)
            out.append(_back(g, y))
        return np.stack(out, axis=1)

    def bias_force(self, nu: Array, rate: ShapeRate) -> Array:
        """F (B, n, d) at ν̇ = 0 of each parameter: Aᵀ (Ȧ ν + ω × u)."""
        A_dot, u = self._rates(nu, rate)
        a = (A_dot @ nu[:, None, :, None])[..., 0] + cross(nu[:, None, 3:6], u)
        out = [_back(self.A, a.reshape(nu.shape[0], -1))]
        if self.term.polar:
            out.append(self._polar_bias(nu, rate))
        return np.stack(out, axis=1)

    def _polar_bias(self, nu: Array, rate: ShapeRate) -> Array:
        """F (B, d) at ν̇ = 0 of the spinning sections: Bᵀ d/dt(y t) with the tangent t carried by its section."""
        q_f_dot = nu[:, None, 6:, None]
        omega = nu[:, None, 3:6]
        relative = (self.shape.spin @ q_f_dot)[..., 0]
        acceleration = (rate.spin @ q_f_dot)[..., 0] + cross(np.broadcast_to(omega, relative.shape), relative)
        y_dot = np.einsum("...i,...i->...", self.shape.tangent, acceleration)
        y = _apply(self.S, nu) / self.root
        tangent = np.broadcast_to(self.shape.tangent, relative.shape)
        moment = self.term.weights[:, None] * (y_dot[..., None] * tangent + y[..., None] * cross(omega + relative, tangent))
        F = np.zeros_like(nu)
        F[:, 3:6] = moment.sum(axis=1)
        F[:, 6:] = np.einsum("bgik,bgi->bk", np.broadcast_to(self.shape.spin, (*moment.shape, F.shape[1] - 6)), moment)
        return F


def _apply(A: Array, nu: Array) -> Array:
    """A ν, (B, rows)."""
    return np.asarray((A @ nu[..., None])[..., 0])


def _back(A: Array, u: Array) -> Array:
    """Aᵀ u, (B, d)."""
    return np.asarray((u[:, None, :] @ A)[:, 0])


def _square(A: Array, nu: Array) -> Array:
    """½ |A ν|², (B,)."""
    u = _apply(A, nu)
    return np.asarray(0.5 * np.einsum("br,br->b", u, u))


def _dot(t: Array, columns: Array) -> Array:
    """tᵀ columns: (B, G, 3) with (B, G, 3, n) to (B, G, n)."""
    return np.asarray((t[..., None, :] @ columns)[..., 0, :])
