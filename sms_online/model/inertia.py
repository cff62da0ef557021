"""Kinetic terms of the model: bodies of constant inertia and flexible links, linear in π, (7), (15), (17).

A term sees its local speeds ν (B, d): the twist of its frame, then the rates of d - 6 coordinates of its own. For each
of its n parameters it gives the local momentum p = ∂K/∂ν, the convective part g with force F = ṗ - g (Newton–Euler in
body axes), and the force F at ν̇ = 0; all as columns (B, d, n).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from sms_online.model.chain import Configuration
from sms_online.model.flexible import Shape, ShapeRate
from sms_online.model.so3 import cross, moment, skew
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
        out = np.empty((twist.shape[0], 6 + own.shape[1], twist.shape[2]))
        out[:, :6] = twist
        out[:, 6:] = own
        return out


@dataclass(frozen=True)
class BodyTerm(Term):
    """Rigid bodies that share a frame: matrices (n, d, d), one for each parameter."""

    matrices: Array

    def of_parameters(self, wanted: Collection[int]) -> BodyTerm:
        """The same with some parameters of π alone."""
        kept = [k for k, parameter in enumerate(self.parameters) if parameter in wanted]
        return replace(self, parameters=tuple(self.parameters[k] for k in kept), matrices=self.matrices[kept])

    def momentum(self, nu: Array) -> Array:
        """p (B, d, n) of each parameter."""
        n, d, _ = self.matrices.shape
        return (nu @ self.matrices.transpose(2, 1, 0).reshape(d, d * n)).reshape(-1, d, n)

    def energy(self, nu: Array) -> Array:
        """K (B, n) of each parameter."""
        n, d, _ = self.matrices.shape
        products = (nu[:, :, None] * nu[:, None]).reshape(-1, d * d)
        return products @ (0.5 * self.matrices.reshape(n, d * d).T)


def convective(nu: Array, p: Array) -> Array:
    """Convective part g (B, d, n) of body-axes momenta p (B, d, n) whose mass matrix is constant."""
    turn = skew(nu[:, :6].reshape(-1, 2, 3))  # v×, ω×
    g = np.zeros_like(p)
    g[:, :6] = (turn[:, 1:] @ p[:, :6].reshape(-1, 2, 3, p.shape[2])).reshape(-1, 6, p.shape[2])
    g[:, 3:6] += turn[:, 0] @ p[:, :3]
    return -g


@dataclass(frozen=True)
class LinkTerm(Term):
    """A flexible link: mass per length and, in space, polar inertia per length."""

    link: int  # from 0
    weights: Array  # (G,) m, or (B, G)
    polar: bool


class LinkMotion:
    """Kinetic quantities of one flexible link at B configurations.

    A point's velocity is A ν with A = [1, -r×, J]; a section's axial spin is S ν with S = tᵀ [0, 1, spin].
    """

    def __init__(self, term: LinkTerm, configuration: Configuration) -> None:
        shape = configuration.shape(term.link)
        assert shape is not None
        self.term = term
        self.shape: Shape = shape
        self.size = configuration.size

    def _velocities(self, nu: Array, elastic: Array) -> Array:
        """A ν (B, G, 3) of the quadrature points, m/s, in {i}; elastic: J times the rates of the link's own speeds."""
        return self.shape.points @ skew(nu[:, 3:6]).swapaxes(1, 2) + nu[:, None, :3] + elastic

    def _collect(self, f: Array) -> Array:
        """Aᵀ f (B, d) of forces f (B, G, 3) on the points."""
        return np.concatenate(
            (f.sum(axis=1), moment(self.shape.points, f), _columns_transposed(self.shape.J, f)), axis=1
        )

    def _spins(self, nu: Array) -> Array:
        """S ν (B, G), rad/s."""
        section = nu[:, None, 3:6] + _columns(self.shape.spin, nu[:, 6:])
        return _dot(self.shape.tangent, section)

    def _collect_moments(self, m: Array) -> Array:
        """[0, 1, spin]ᵀ m (B, d) of moments m (B, G, 3) on the sections."""
        return np.concatenate(
            (np.zeros((self.size, 3)), m.sum(axis=1), _columns_transposed(self.shape.spin, m)), axis=1
        )

    def energy(self, nu: Array) -> Array:
        """K (B, n) of each parameter."""
        u = self._velocities(nu, _columns(self.shape.J, nu[:, 6:]))
        out = [0.5 * ((u * u).sum(axis=2) @ self.term.weights)]
        if self.term.polar:
            out.append(0.5 * (self._spins(nu) ** 2 @ self.term.weights))
        return np.stack(out, axis=1)

    def momentum(self, nu: Array) -> Array:
        """p (B, d, n) of each parameter."""
        weights = self.term.weights[..., None]
        out = [self._collect(self._velocities(nu, _columns(self.shape.J, nu[:, 6:])) * weights)]
        if self.term.polar:
            out.append(self._collect_moments(self._spins(nu)[..., None] * self.shape.tangent * weights))
        return np.stack(out, axis=2)

    def mass_matrix(self, pi: Array) -> Array:
        """Local mass matrix (B, d, d) for the term's parameters."""
        shape, G = self.shape, self.term.weights.size
        root = np.sqrt(self.term.weights)
        A = np.zeros((self.size, G, 3, 6 + shape.J.shape[-1]))
        A[..., :3] = np.eye(3)
        A[..., 3:6] = -skew(shape.points)
        A[..., 6:] = shape.J
        A = (A * root[:, None, None]).reshape(self.size, 3 * G, -1)
        M = pi[0] * (A.transpose(0, 2, 1) @ A)
        if self.term.polar:
            S = np.zeros((self.size, G, A.shape[2]))
            S[..., 3:6] = shape.tangent
            S[..., 6:] = (shape.tangent[..., None, :] @ shape.spin)[..., 0, :]
            S *= root[:, None]
            M += pi[1] * (S.transpose(0, 2, 1) @ S)
        return np.asarray(M)

    def momentum_and_convective(self, nu: Array, rate: ShapeRate) -> tuple[Array, Array]:
        """p and g (B, d, n) of each parameter: g = Ȧᵀ u - Aᵀ (ω × u), for the axial spin with tᵀ [0, 1, spin] as A."""
        weights = self.term.weights[..., None]
        elastic = _columns(self.shape.J, nu[:, 6:])
        u = self._velocities(nu, elastic) * weights
        g = -self._collect(_turn(nu, u))
        g[:, 3:6] += moment(elastic, u)
        g[:, 6:] += _columns_transposed(rate.J, u)
        momenta, forces = [self._collect(u)], [g]
        if self.term.polar:
            momentum = self._spins(nu)[..., None] * self.shape.tangent * weights
            g = -self._collect_moments(_turn(nu, momentum))
            g[:, 6:] += _columns_transposed(rate.spin, momentum)
            momenta.append(self._collect_moments(momentum))
            forces.append(g)
        return np.stack(momenta, axis=2), np.stack(forces, axis=2)

    def bias_force(self, nu: Array, rate: ShapeRate) -> Array:
        """F (B, d, n) at ν̇ = 0 of each parameter: Aᵀ (Ȧ ν + ω × u), and [0, 1, spin]ᵀ d/dt(y t)."""
        weights = self.term.weights[..., None]
        elastic = _columns(self.shape.J, nu[:, 6:])
        a = _turn(nu, elastic + self._velocities(nu, elastic)) + _columns(rate.J, nu[:, 6:])
        out = [self._collect(a * weights)]
        if self.term.polar:
            relative = np.broadcast_to(_columns(self.shape.spin, nu[:, 6:]), (self.size, *self.shape.spin.shape[1:3]))
            tangent = np.broadcast_to(self.shape.tangent, relative.shape)
            y = self._spins(nu)[..., None]
            y_dot = _dot(tangent, _turn(nu, relative) + _columns(rate.spin, nu[:, 6:]))[..., None]
            # The tangent is carried by its section: dt/dt = (ω + relative spin) × t.
            change = y_dot * tangent + y * (_turn(nu, tangent) + cross(relative, tangent))
            out.append(self._collect_moments(change * weights))
        return np.stack(out, axis=2)


def _turn(nu: Array, u: Array) -> Array:
    """ω × u for vectors u (B, G, 3)."""
    return np.asarray(u @ skew(nu[:, 3:6]).transpose(0, 2, 1))


def _columns(J: Array, rates: Array) -> Array:
    """J (B or 1, G, 3, n) times rates (B, n), as (B, G, 3)."""
    n = J.shape[-1]
    if J.shape[0] == 1:  # a constant Jacobian takes one matrix product for the whole block
        return (rates @ J.reshape(-1, n).T).reshape(-1, *J.shape[1:3])
    return (J.reshape(J.shape[0], -1, n) @ rates[..., None]).reshape(-1, *J.shape[1:3])


def _columns_transposed(J: Array, f: Array) -> Array:
    """Jᵀ f (B, n) of f (B, G, 3)."""
    n = J.shape[-1]
    if J.shape[0] == 1:
        return f.reshape(f.shape[0], -1) @ J.reshape(-1, n)
    return np.asarray((f.reshape(f.shape[0], 1, -1) @ J.reshape(J.shape[0], -1, n))[:, 0])


def _dot(a: Array, b: Array) -> Array:
    """Inner products along the last axis."""
    return np.asarray((a * b).sum(axis=-1))
