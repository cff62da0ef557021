"""Physical consistency: whether some distribution of mass has these parameters, and the nearest that one has.

Masses per length, stiffnesses, dampings, rigidities and rotors' inertias are not negative. A rigid body is a
distribution of mass that is nowhere negative if and only if its pseudo-inertia

    [[½ tr(I) 1 - I, h], [hᵀ, m]]    in space,    [[I_zz, h_x, h_y], [h_x, m, 0], [h_y, 0, m]]    in the plane

is positive semidefinite, with I and the first moment h about the frame's origin. Source: Wensing, Kim, Slotine, IEEE
Robotics and Automation Letters 3 (2018) 60. Base parameters β are consistent where some consistent π maps to them
(Sousa, Cortesão, Int. J. Robotics Research 33 (2014) 931).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.stream import Array, Mask

# The squared distance, in standard deviations, that the barrier's last weight may add.
GAP = 1e-6
# From one weight of the barrier to the next.
SHRINK = 0.01
# A condition that holds the estimate follows the barrier's weight to zero, by SHRINK from one weight to the next; one
# that does not hold it stays where it is.
ACTIVE_FALL = 0.03
# Nearer than this many standard deviations is consistent: ten times what the barrier adds.
INSIDE = 1e-2
# Squared Newton decrement, in weights of the barrier, at which a weight is done with.
CENTRED = 1e-3
# Newton steps in all; a hundred are usual.
MAX_STEPS = 500
# Part of the predicted decrease that a step has to reach.
ARMIJO = 0.1
# No parameter of a body, and no other one, is larger than this many times the largest estimate of its kind (or 1 in SI
# units): what the data do not determine must be bounded.
FAR = 1e4
# Eigenvalues of a correlation matrix below this share of the largest are rounding.
CORRELATION_ROUNDING = 1e-13
# Standard deviations below this share of the estimate are rounding.
RELATIVE_ROUNDING = 1e-12


@dataclass(frozen=True)
class Projection:
    """The consistent base parameters nearest to an estimate.

    beta (n,). distance: from the estimate, in standard deviations of the joint posterior; 0 where it is consistent, and
    beta is then the estimate itself. active: the conditions in the way, as names of parameters that would be negative
    and of bodies that would have negative mass somewhere.
    """

    beta: Array
    distance: float
    active: tuple[str, ...]


class PhysicalSet:
    """The consistent parameters of a model, {π: A π > 0, F_0 + Σ π_k F_k ≻ 0 for every body}.

    Parameters that are declared known are what they are declared; a body of which they leave no realisable one, and
    coefficients of effects, which may have either sign, are not bounded.
    """

    def __init__(self, model: Model, base: BaseParameters, changes: Sequence[str] = ()) -> None:
        """changes: owners of parameters that are what a body has changed by, not bounded either: one that is released
        takes as much away as one that is grasped adds."""
        known = dict(base.known)
        effects = {k for columns in model.effect_slices for k in range(columns.start, columns.stop)}
        bodies, others = _bodies(model)
        unknown = [k for k in range(model.n_pi) if k not in known]
        values = np.array([known.get(k, 0.0) for k in range(model.n_pi)])
        signed = [k for k in others if k not in known and k not in effects]
        self._A = np.eye(model.n_pi)[signed][:, unknown]
        self._names = [model.parameters[k].name for k in signed]
        # A dependent parameter that sticks to zero only passes on what its combination's leading one lacks.
        self._leads = [k in base.independent for k in signed]
        self._F, self._F_0 = np.zeros((0, 4, 4, len(unknown))), np.zeros((0, 4, 4))
        self._start = np.ones(len(unknown))
        for owner, block in bodies.items():
            if owner in changes:
                continue
            free, constant = block[..., unknown], block @ values
            unused = ~block.any(axis=(1, 2))
            constant[unused, unused] = 1.0
            columns = np.flatnonzero(free.any(axis=(0, 1)))
            flat = free[..., columns].reshape(16, -1)
            start = np.linalg.lstsq(flat, (np.eye(4) - constant).ravel(), rcond=None)[0]
            realisable = np.linalg.eigvalsh(constant + (flat @ start).reshape(4, 4))[0] > 0.0
            if columns.size and realisable:
                self._start[columns] = start
                self._names.append(owner)
                self._leads.append(bool(block[..., list(base.independent)].any()))
                self._F = np.concatenate((self._F, free[None]))
                self._F_0 = np.concatenate((self._F_0, constant[None]))
        T = np.zeros((base.n, model.n_pi))
        T[np.arange(base.n), list(base.independent)] = 1.0
        T[:, list(base.dependent)] = base.mixture
        self._T = T[:, unknown]
        inertial = np.zeros(model.n_pi, dtype=bool)
        inertial[[k for term in model.bodies for k in term.parameters]] = True
        self._inertial, self._leading_inertial = inertial[unknown], inertial[list(base.independent)]

    def project(self, beta: Array, covariance: Array) -> Projection:
        """The consistent parameters β* nearest to β (n,) by (β* - β)ᵀ Λ (β* - β), Λ the inverse of the covariance.

        covariance (n, n): of the posterior, with infinite variance where nothing is determined; such parameters bound
        nothing and stay as they are. By a path of logarithmic barriers, which Newton's method follows whatever the
        units are (Boyd, Vandenberghe, Convex Optimization (2004), ch. 11).
        Raises ArithmeticError where it does not converge.
        """
        determined = np.isfinite(np.diag(covariance))
        std = np.sqrt(np.diag(covariance)[determined])
        std = np.maximum(std, RELATIVE_ROUNDING * np.abs(beta[determined]) + np.finfo(np.float64).tiny)
        correlation = covariance[np.ix_(determined, determined)] / std / std[:, None]
        values, V = np.linalg.eigh(correlation)
        values = np.maximum(values, CORRELATION_ROUNDING * values.max(initial=0.0))
        root = (V / np.sqrt(values)).T / std  # Λ = rootᵀ root
        far = np.empty(self._start.size)
        for inertial in (True, False):
            sizes = np.abs(beta[determined & (self._leading_inertial == inertial)])
            far[self._inertial == inertial] = FAR * max(1.0, float(sizes.max(initial=0.0)))
        barrier = _Barrier(self._A, self._F, self._F_0, far, root @ self._T[determined], root @ beta[determined])
        try:
            pi, active = _follow(barrier, self._start)
        except np.linalg.LinAlgError as error:  # rounding, where a condition is met by next to nothing
            raise ArithmeticError(str(error)) from None
        distance = barrier.distance(pi)
        if distance <= INSIDE:
            return Projection(beta, 0.0, ())
        leading = active & np.array(self._leads)
        shown = leading if leading.any() else active
        names = tuple(name for name, holds in zip(self._names, shown, strict=True) if holds)
        return Projection(np.where(determined, self._T @ pi, beta), distance, names)


@dataclass(frozen=True)
class _Barrier:
    """½ ‖M π - target‖² / weight - log det of all conditions: of A π > 0, F_0 + Σ π_k F_k ≻ 0 and |π| < far."""

    A: Array
    F: Array
    F_0: Array
    far: Array
    M: Array
    target: Array

    @property
    def degree(self) -> int:
        """By how much the squared distance exceeds the least one at the minimum, in weights, at most."""
        return 2 * (len(self.A) + 4 * len(self.F) + 2 * self.far.size)

    def distance(self, pi: Array) -> float:
        """From the target, in standard deviations."""
        return float(np.linalg.norm(self.M @ pi - self.target))

    def _bodies(self, pi: Array) -> Array:
        return np.asarray(self.F_0 + self.F @ pi)

    def margins(self, pi: Array) -> Array:
        """What falls to zero where a condition holds π: A π, and the determinants of the bodies."""
        return np.concatenate((self.A @ pi, np.linalg.det(self._bodies(pi))))

    def value(self, pi: Array, weight: float) -> float:
        """Infinite where a condition is not met."""
        within = np.concatenate((self.A @ pi, self.far - pi, self.far + pi))
        if within.min() <= 0.0:
            return np.inf
        try:
            pivots = np.diagonal(np.linalg.cholesky(self._bodies(pi)), axis1=1, axis2=2)
        except np.linalg.LinAlgError:
            return np.inf
        return float(0.5 * self.distance(pi) ** 2 / weight - np.log(within).sum() - 2.0 * np.log(pivots).sum())

    def _rows(self, pi: Array) -> tuple[Array, Array]:
        """J and r with JᵀJ the Hessian of the conditions' part and -Jᵀ r its gradient."""
        L_inverse = np.linalg.inv(np.linalg.cholesky(self._bodies(pi)))
        wide = len(self.F), 4, 4 * pi.size
        half = (L_inverse @ self.F.reshape(wide)).reshape(self.F.shape).swapaxes(1, 2)
        bodies = (L_inverse @ half.reshape(wide)).reshape(-1, pi.size)  # L⁻¹ F_k L⁻ᵀ
        lower, upper = np.diag(1.0 / (pi + self.far)), np.diag(1.0 / (pi - self.far))
        J = np.concatenate((self.A / (self.A @ pi)[:, None], lower, upper, bodies))
        ones = np.ones(len(self.A) + 2 * pi.size)
        return J, np.concatenate((ones, np.broadcast_to(np.eye(4), self.F_0.shape).ravel()))

    def newton(self, pi: Array, weight: float) -> tuple[Array, bool]:
        """π one step on, and whether it was the last one for this weight.

        The step is a least-squares problem, whose condition is the root of the Hessian's.
        """
        J, r = self._rows(pi)
        rows = np.concatenate((self.M / np.sqrt(weight), J))
        norms = np.linalg.norm(rows, axis=0)
        ahead = np.concatenate(((self.target - self.M @ pi) / np.sqrt(weight), r))
        triangle = np.asarray(np.linalg.qr(np.column_stack((rows / norms, ahead)), mode="r"))
        R, ahead = triangle[:-1, :-1], triangle[:-1, -1]
        step = np.linalg.solve(R, ahead) / norms
        decrement = float(ahead @ ahead)
        value, length = self.value(pi, weight), 1.0
        while not self.value(pi + length * step, weight) <= value - ARMIJO * length * decrement:
            length *= 0.5
            if length * decrement < CENTRED:
                return pi, True  # rounding hides what is left to gain
        return pi + length * step, decrement < CENTRED

    def straight(self, pi: Array) -> Array:
        """π with the target, reached by the step that is shortest in the barrier's own metric."""
        J, _ = self._rows(pi)
        norms = np.linalg.norm(J, axis=0)
        R = np.linalg.qr(J / norms, mode="r") * norms
        step = np.linalg.lstsq(np.linalg.solve(R.T, self.M.T).T, self.target - self.M @ pi, rcond=None)[0]
        return np.asarray(pi + np.linalg.solve(R, step))


def _follow(barrier: _Barrier, pi: Array) -> tuple[Array, Mask]:
    """π nearest to the target, from one that meets all conditions, and which conditions hold it."""
    weight = max(1.0, barrier.distance(pi) ** 2 / barrier.degree)
    margins = barrier.margins(pi)
    steps = 0
    while True:
        centred = False
        while not centred:
            if steps == MAX_STEPS:
                raise ArithmeticError("the projection onto consistent parameters does not converge")
            pi, centred = barrier.newton(pi, weight)
            steps += 1
        before, margins = margins, barrier.margins(pi)
        if weight * barrier.degree <= GAP:
            return pi, margins < ACTIVE_FALL * before
        # Most estimates are consistent, and then the path need not be followed to its end.
        direct = barrier.straight(pi)
        if np.isfinite(barrier.value(direct, weight)) and barrier.distance(direct) <= INSIDE:
            return direct, np.zeros(margins.size, dtype=bool)
        weight *= SHRINK


def _bodies(model: Model) -> tuple[dict[str, Array], list[int]]:
    """Pseudo-inertias (4, 4, n_pi) by body, columns of zeros where no parameter belongs to it; the other parameters.

    A stator is balanced about its joint, so its mass and inertia are independent.
    """
    planar = model.layout.planar
    bodies: dict[str, Array] = {}
    others: list[int] = []
    for term in model.bodies:
        for index, matrix in zip(term.parameters, term.matrices, strict=True):
            parameter = model.parameters[index]
            stator = parameter.owner.startswith("motor_") and not matrix[6:].any() and not matrix[0, 0]
            if parameter.owner.startswith("motor_") and (planar or not stator):
                others.append(index)
                continue
            block = bodies.setdefault(parameter.owner, np.zeros((4, 4, model.n_pi)))
            block[..., index] = _pseudo_inertia(matrix[:6, :6], planar)
    in_bodies = {k for term in model.bodies for k in term.parameters}
    return bodies, others + [k for k in range(model.n_pi) if k not in in_bodies]


def _pseudo_inertia(E: Array, planar: bool) -> Array:
    """Pseudo-inertia (4, 4) of a body with the inertia matrix E (6, 6), linear over angular; in the plane of size 3."""
    m, h, inertia = E[0, 0], np.array([E[5, 1], E[3, 2], E[4, 0]]), E[3:, 3:]
    if planar:
        return np.array([[inertia[2, 2], h[0], h[1], 0.0], [h[0], m, 0.0, 0.0], [h[1], 0.0, m, 0.0], [0.0] * 4])
    out = np.zeros((4, 4))
    out[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    out[:3, 3] = out[3, :3] = h
    out[3, 3] = m
    return out
