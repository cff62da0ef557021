"""Simulation in step with the clock: fixed implicit steps of 1 ms, solved several at once.

One call of the model costs about 1 ms of a core, whether for one state or for fifty. So the Newton iteration runs over
STEPS_AT_ONCE consecutive steps together: one batched call gives the right-hand sides of all their stages, then the
linearised steps are solved one after the other, each from the end of the one before. The Jacobian comes out of the
first of these calls. Converged, the steps are those that solving singly would give.
Source of the step: Radau IIA, Hairer & Wanner II, IV.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_online.stream import Array
from sms_sim.integrate import JACOBIAN_INCREMENT, radau
from sms_sim.plant import Plant

STEP = 1e-3  # s, the sample interval of the simulated bus
# Order 5: the planar example's modes of 750 rad/s turn by 0.75 rad a step, which order 3 would damp visibly.
STAGES = 3
# 24 states a call, which still costs little more than one; the bus sees bursts of 8 ms.
STEPS_AT_ONCE = 8
# Newton iterations of a block: a fixed number, so that its cost is fixed too. In the planar example one leaves an
# energy error of 2e-4, two 9e-6.
ITERATIONS = 2
# A block's motion is first guessed by extending that of the three before it, latest first, along a parabola.
EXTRAPOLATION = np.array([3.0, -3.0, 1.0])


@dataclass(frozen=True)
class Sample:
    """The plant at the instant t, s: positions x (n_x,), speeds v (n_v,), torque after the gear n τ (joints,), N m."""

    t: float
    x: Array
    v: Array
    torque: Array


class RealTimeStepper:
    """A plant that advances by STEP a call, from rest, in less than STEP of one core for the planar example."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self._y = plant.rest
        self._steps = 0  # solved so far
        method = radau(STAGES)
        self._c = method.c
        self._A_inverse = np.asarray(np.linalg.inv(method.A), dtype=np.float64)
        # Increments from a block's start to its stages, of the last blocks, latest first: (3, K, s, n).
        self._increments = np.zeros((EXTRAPOLATION.size, STEPS_AT_ONCE, STAGES, self._y.size))
        self._ready: list[Sample] = []

    def step(self) -> Sample:
        """The state STEP later; the first call gives t = STEP. Raises ArithmeticError where the motion diverges."""
        if not self._ready:
            self._ready = self._block()[::-1]
        return self._ready.pop()

    def _block(self) -> list[Sample]:
        """Solve the next STEPS_AT_ONCE steps."""
        starts = (self._steps + np.arange(STEPS_AT_ONCE)) * STEP
        t = starts[:, None] + STEP * self._c
        Y = self._y + np.tensordot(EXTRAPOLATION, self._increments, axes=1)
        F = self._linearise(t, Y)
        Y = Y + self._change(Y, F)
        for _ in range(ITERATIONS - 1):
            F = self.plant.rate(t.ravel(), Y.reshape(-1, Y.shape[2])).reshape(Y.shape)
            Y = Y + self._change(Y, F)
        if not np.isfinite(Y).all():
            raise ArithmeticError(f"the motion diverges at t = {starts[0]:.3f} s: too fast for steps of {STEP} s")
        self._increments = np.stack((Y - self._y, *self._increments[:-1]))
        ends = self.plant.normalised(Y[:, -1])
        self._y = ends[-1]
        self._steps += STEPS_AT_ONCE
        times = np.asarray(starts + STEP, dtype=np.float64)
        x, v = self.plant.split(ends)
        torque = self.plant.torque(times, ends)
        return [Sample(float(times[k]), x[k], v[k], torque[k]) for k in range(STEPS_AT_ONCE)]

    def _linearise(self, t: Array, Y: Array) -> Array:
        """ẏ at the stages Y (K, s, n); takes the Jacobian in the middle of the block on the way."""
        n = Y.shape[2]
        middle = STEPS_AT_ONCE // 2
        increment = JACOBIAN_INCREMENT * np.maximum(1.0, np.abs(Y[middle, 0]))
        times = np.concatenate((t.ravel(), np.full(n, t[middle, 0])))
        states = np.concatenate((Y.reshape(-1, n), Y[middle, 0] + np.diag(increment)))
        rates = self.plant.rate(times, states)
        F = rates[: t.size].reshape(Y.shape)
        jacobian = ((rates[t.size :] - F[middle, 0]) / increment[:, None]).T
        # On the stacked stages of a step: (A⁻¹ ⊗ 1 / h - 1 ⊗ J)⁻¹, and what moving the step's start does to them.
        shift = np.kron(self._A_inverse / STEP, np.eye(n))
        self._solve = np.linalg.inv(shift - np.kron(np.eye(STAGES), jacobian))
        self._carry = self._solve @ shift.reshape(-1, STAGES, n).sum(axis=1)
        return F

    def _change(self, Y: Array, F: Array) -> Array:
        """Newton's correction (K, s, n) of A⁻¹ (Y - y_start) / h = F over all steps of the block."""
        start = np.concatenate((self._y[None], Y[:-1, -1]))
        residual = F - self._A_inverse @ (Y - start[:, None]) / STEP
        change = np.reshape(residual.reshape(STEPS_AT_ONCE, -1) @ self._solve.T, Y.shape)
        for k in range(1, STEPS_AT_ONCE):
            change[k] += (self._carry @ change[k - 1, -1]).reshape(STAGES, -1)
        return change
