"""Radau IIA collocation for stiff equations whose right-hand side is evaluated in batches.

A model call costs nearly the same for one state as for fifty. So all stages of a step are evaluated in one call, and
so is the whole finite-difference Jacobian; a method of many stages then costs no more a step than one of few. SciPy's
Radau (3 stages, order 5, one state a call) needs minutes where this needs seconds.
Source: Hairer, Wanner, Solving Ordinary Differential Equations II, 2nd ed. 1996, sections IV.5 and IV.8.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import roots_jacobi

from sms_online.stream import Array

# f(t (B,), y (B, n)) -> ẏ (B, n): B independent states at B instants.
RightHandSide = Callable[[Array, Array], Array]

# Step factors after an accepted or rejected step, Hairer & Wanner IV.8.
SAFETY, SHRINK, GROW = 0.9, 0.2, 4.0
# A step that would change by less is kept: its factors stay good.
KEEP_STEP = (1.0, 1.2)
# Starts from rest with a jump in torque: the first step resolves the fastest pole, then steps grow by GROW.
FIRST_STEP = 1e-6  # s
# Stages of the exact simulation, order 17: of 3 to 11, the cheapest at a tolerance of 1e-11.
STAGES = 9
# Iteration stops when what is left is this part of the tolerance: far below the error that the step control lets
# through, for what Newton leaves is biased and adds up over the steps.
NEWTON_PART = 1e-3
# More iterations than this mean that a shorter step is cheaper.
NEWTON_LIMIT = 10
# A Jacobian that contracts the iteration faster than this is kept for the next step.
KEEP_CONTRACTION = 0.02
# Relative increment of forward differences: half the digits of a double.
JACOBIAN_INCREMENT = float(np.sqrt(np.finfo(float).eps))
# A step shorter than this (s) is not a stiff problem any more but a singular one.
SHORTEST_STEP = 1e-10


@dataclass(frozen=True)
class Radau:
    """Coefficients of the Radau IIA method with s stages (s odd), order 2s - 1.

    c (s,): nodes, the last is 1. A (s, s); its last row are the weights b. A⁻¹ = T diag(eigenvalues) T⁻¹, complex, of
    which p = (s + 1) / 2 are kept: the real one first, then one of each conjugate pair. T (s, p) has the columns of the
    latter doubled, so that the real part of T w is the whole product; T_inverse (p, s). error_weights (s,): the
    embedded estimate of IV.8, (8.17), with the left end's rate at weight 1. basis (s, s): from the powers θ … θ^s to
    the Lagrange polynomials on the nodes {0, c} that vanish at 0.
    """

    c: Array
    A: Array
    T: NDArray[np.complex128]
    T_inverse: NDArray[np.complex128]
    eigenvalues: NDArray[np.complex128]
    error_weights: Array
    basis: Array

    @property
    def stages(self) -> int:
        """Number of stages s."""
        return int(self.c.size)

    def onward(self, Z: Array, ratio: float = 1.0) -> Array:
        """Stage increments (…, s, n) of a step, by extending the polynomial of the step before, of increments Z.

        ratio: of the step's length to that of the step before.
        """
        theta = 1.0 + self.c * ratio
        return np.asarray((theta[:, None] ** np.arange(1, self.stages + 1)) @ self.basis @ Z - Z[..., -1:, :])

    def newton_change(self, h: float, F: Array, Z: Array, inverses: NDArray[np.complex128]) -> Array:
        """Change (…, s, n) of Z by one simplified Newton iteration on Z = h A F.

        inverses (…, p, n, n): of eigenvalue / h - Jacobian.
        """
        # T⁻¹ (F - A⁻¹ Z / h), each component solved with its own shift.
        residual = self.T_inverse @ F - (self.eigenvalues[:, None] / h) * (self.T_inverse @ Z)
        return np.asarray(np.real(self.T @ (inverses @ residual[..., None])[..., 0]))


@cache
def radau(stages: int) -> Radau:
    """Radau IIA with an odd number of stages; nodes are the zeros of the right Radau polynomial."""
    interior, _ = roots_jacobi(stages - 1, 1.0, 0.0)
    c = np.append(0.5 * (interior + 1.0), 1.0)
    powers = np.arange(1, stages + 1)
    # Collocation: Σ_j a_ij c_j^(k-1) = c_i^k / k.
    vandermonde = c[:, None] ** (powers - 1)
    A = np.asarray(np.linalg.solve(vandermonde.T, (c[:, None] ** powers / powers).T).T, dtype=np.float64)
    eigenvalues, T = np.linalg.eig(np.linalg.inv(A).astype(complex))
    order = np.argsort(np.abs(eigenvalues.imag))
    kept = np.array([k for k in order if k == order[0] or eigenvalues[k].imag > 0])
    gamma_0 = 1.0 / float(eigenvalues[kept[0]].real)
    # b̂ integrates degree s - 1 exactly with the weight γ_0 on the left end.
    right_side = 1.0 / powers
    right_side[0] -= gamma_0
    b_hat = np.linalg.solve(vandermonde.T, right_side)
    return Radau(
        c=c,
        A=A,
        T=T[:, kept] * np.where(np.arange(kept.size) == 0, 1.0, 2.0),
        T_inverse=np.linalg.inv(T)[kept],
        eigenvalues=eigenvalues[kept],
        error_weights=(b_hat - A[-1]) / gamma_0,
        basis=np.linalg.inv(c[:, None] ** powers),
    )


@dataclass(frozen=True)
class Dense:
    """A solution between its steps: the collocation polynomials.

    t (M + 1,) s: step ends. y (M + 1, n): states there. stages (M, s, n): states at t_m + c_i h_m.
    """

    method: Radau
    t: Array
    y: Array
    stages: Array

    @property
    def stage_times(self) -> Array:
        """Instants of the stages (M, s), s."""
        return self.t[:-1, None] + np.diff(self.t)[:, None] * self.method.c

    def _locate(self, t: Array) -> tuple[NDArray[np.intp], Array]:
        step = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, self.t.size - 2)
        theta = (t - self.t[step]) / (self.t[step + 1] - self.t[step])
        return step, theta[:, None] ** np.arange(1, self.method.stages + 1) @ self.method.basis

    def __call__(self, t: Array) -> Array:
        """States (B, n) at instants t (B,) within the solution."""
        step, weights = self._locate(t)
        left = self.y[step]
        return np.asarray(left + (weights[:, None] @ (self.stages[step] - left[:, None]))[:, 0])

    def integral(self, rates: Array, t: Array) -> Array:
        """∫ from the start to t (B,) of functions with values `rates` (M, s, k) at the stages: (B, k).

        Superconvergent at step ends, of the polynomials' order s + 1 between them.
        """
        h = np.diff(self.t)[:, None, None]
        increments = h * (self.method.A @ rates)
        ends = np.concatenate((np.zeros((1, rates.shape[2])), np.cumsum(increments[:, -1], axis=0)))
        step, weights = self._locate(t)
        return np.asarray(ends[step] + (weights[:, None] @ increments[step])[:, 0])


def finite_difference_jacobians(f: RightHandSide, t: float, y: Array) -> tuple[Array, Array]:
    """ẏ (P, n) and ∂ẏ/∂y (P, n, n) at states y (P, n), in one batched call."""
    P, n = y.shape
    increment = JACOBIAN_INCREMENT * np.maximum(1.0, np.abs(y))
    states = np.repeat(y[:, None], n + 1, axis=1)
    states[:, 1:][:, np.arange(n), np.arange(n)] += increment
    rates = f(np.full(P * (n + 1), t), states.reshape(-1, n)).reshape(P, n + 1, n)
    return rates[:, 0], ((rates[:, 1:] - rates[:, :1]) / increment[:, :, None]).transpose(0, 2, 1)


class Collocation:
    """One step of Radau IIA after another on ẏ = f(t, y), with simplified Newton iterations."""

    def __init__(self, f: RightHandSide, t: float, y: Array, stages: int) -> None:
        self.method = radau(stages)
        self.f = f
        self.t = t
        self.y = y
        self._previous: tuple[float, Array] | None = None  # step and stage increments of the last step
        self._factored_step = 0.0
        self.refresh()

    def refresh(self) -> None:
        """Take the Jacobian at the present state, in one batched call."""
        (self.rate,), (self._jacobian,) = finite_difference_jacobians(self.f, self.t, self.y[None])
        self._factored_step = 0.0

    def _factor(self, h: float) -> None:
        if h == self._factored_step:
            return
        shifts = self.method.eigenvalues[:, None, None] / h
        # Explicit inverses: the iteration corrects their rounding, and products are faster than substitutions.
        self._inverses = np.linalg.inv(shifts * np.eye(self.y.size) - self._jacobian)
        self._factored_step = h

    def _start(self, h: float) -> Array:
        """Stage increments (s, n) by extending the polynomial of the step before."""
        if self._previous is None:
            return np.zeros((self.method.stages, self.y.size))
        previous_h, Z = self._previous
        return self.method.onward(Z, h / previous_h)

    def newton_step(self, h: float, Z: Array) -> tuple[Array, Array, Array]:
        """One simplified Newton iteration on Z = h A F(y + Z), one batched call: new Z, its change, and F (s, n)."""
        F = self.f(self.t + self.method.c * h, self.y + Z)
        change = self.method.newton_change(h, F, Z, self._inverses)
        return Z + change, change, F

    def error(self, h: float, F: Array) -> Array:
        """Embedded estimate (n,) of the local error, filtered as (8.19) so that stiff components do not dominate it."""
        return np.asarray(self._inverses[0].real @ (self.rate + self.method.error_weights @ F))

    def advance(self, h: float, Z: Array, F: Array) -> None:
        """Accept a step of h with increments Z and rates F at its stages."""
        self._previous = (h, Z)
        self.t += h
        self.y = self.y + Z[-1]
        self.rate = F[-1]

    def iterate(self, h: float, tolerance: Array) -> tuple[Array, Array, float] | None:
        """Solve a step to NEWTON_PART of `tolerance` (n,): increments, F, contraction; None if it does not converge."""
        self._factor(h)
        Z = self._start(h)
        contraction, size_before = 0.0, np.inf
        for k in range(NEWTON_LIMIT):
            # A step that is far too long may overflow; it is given up below.
            with np.errstate(over="ignore", invalid="ignore"):
                Z, change, F = self.newton_step(h, Z)
            size = float(np.sqrt(np.mean((change / tolerance) ** 2)))
            if not np.isfinite(size):
                return None
            if k > 0:
                contraction = size / size_before
                if contraction >= 1.0 and size > NEWTON_PART:
                    return None
            if size * (contraction / (1.0 - contraction) if 0 < contraction < 1 else 1.0) <= NEWTON_PART:
                return Z, F, contraction
            size_before = size
        return None


@dataclass(frozen=True)
class Step:
    """One accepted step: its end t s, the state there y (n,), and the states at its stages (s, n)."""

    t: float
    y: Array
    stages: Array


def march(f: RightHandSide, y0: Array, duration: float, tolerance: Array, longest: float) -> Iterator[Step]:
    """Integrate ẏ = f(t, y) from y0 (n,) at t = 0 over `duration` (s) with step control, a step at a time.

    tolerance (n,): bound of the estimated local error of each state in its unit. longest: step, s. The estimate is of
    the order of the polynomial between steps, and step ends are better; it does not see what a state that only follows
    a fast pole loses between steps. Raises ArithmeticError where no step is short enough. Source: Hairer & Wanner IV.8.
    """
    collocation = Collocation(f, 0.0, y0, STAGES)
    t, y = 0.0, y0
    h = FIRST_STEP
    fresh = True
    while t < duration:
        left = duration - t
        # Two equal steps to the end, so that the last one is not next to nothing.
        h = left if left <= h else min(h, 0.5 * left, longest)
        if h < SHORTEST_STEP:
            raise ArithmeticError(
                f"the motion cannot be followed at t = {collocation.t:.6f} s: the step has shrunk to {h:.1e} s"
            )
        solved = collocation.iterate(h, tolerance)
        if solved is None:
            if fresh:
                h *= 0.5
            else:
                collocation.refresh()
                fresh = True
            continue
        Z, F, contraction = solved
        error = float(np.sqrt(np.mean((collocation.error(h, F) / tolerance) ** 2)))
        factor = SAFETY * max(error, 1e-20) ** (-1.0 / (STAGES + 1))
        factor = min(GROW, max(SHRINK, factor))
        if error >= 1.0:
            h *= factor
            continue
        collocation.advance(h, Z, F)
        t = duration if h == left else collocation.t
        yield Step(t, collocation.y, y + Z)
        y = collocation.y
        fresh = False
        if contraction > KEEP_CONTRACTION:
            collocation.refresh()
            fresh = True
        if not KEEP_STEP[0] < factor < KEEP_STEP[1]:
            h *= factor


def solve(
    f: RightHandSide,
    y0: Array,
    duration: float,
    tolerance: Array,
    longest: float = np.inf,
    progress: Callable[[float], None] = lambda t: None,
) -> Dense:
    """All of `march` as one solution; progress: is called with the end of each step, s."""
    steps = []
    for step in march(f, y0, duration, tolerance, longest):
        steps.append(step)
        progress(step.t)
    return dense(STAGES, 0.0, y0, steps)


def dense(stages: int, t0: float, y0: Array, steps: Sequence[Step]) -> Dense:
    """Consecutive steps from the state y0 (n,) at t0 as one solution."""
    t = np.array([t0, *(step.t for step in steps)])
    return Dense(
        radau(stages), t, np.array([y0, *(step.y for step in steps)]), np.array([step.stages for step in steps])
    )
