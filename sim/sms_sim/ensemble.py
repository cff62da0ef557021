"""Many motions of one plant at once, each after a reference of its own, by Radau IIA of order five at a common step.

A model call costs nearly the same for one state as for fifty, so thirty motions cost what three would one by one. They
are good to some 1e-3 of their size, which is enough to compare references; what is measured on is simulated by
`simulate`. SciPy's Radau on the stacked states, with their sparsity, takes three times as long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_online.description.schema import System
from sms_online.errors import InputError
from sms_online.stream import Array
from sms_online.threads import one_blas_thread
from sms_sim.controller import JointPD
from sms_sim.integrate import finite_difference_jacobians, radau
from sms_sim.plant import Plant
from sms_sim.references import References

STAGES = 3
# What Newton's iteration leaves of a stage, rad, m and, as of rates, 1/s. What it leaves is to a bound excitation: with
# a thousand times as much that of a weakly determined parameter is a tenth off, another tenth in another batch.
POSITION_TOLERANCE, SPEED_TOLERANCE = 1e-9, 1e-7
# More iterations than this: the Jacobians are too old. As many with new ones: the step is too long.
ITERATIONS = 10
# A step is halved no more often than this: friction reverses within a millisecond.
HALVINGS = 6


@dataclass(frozen=True)
class Motions:
    """P motions at N common instants: t (N,) s, x (P, N, n_x), v (P, N, n_v), torque n τ (P, N, joints); NaN from where
    one could not be followed."""

    t: Array
    x: Array
    v: Array
    torque: Array


@one_blas_thread()
def ensemble(system: System, frequency: Array, sine: Array, cosine: Array, duration: float, step: float) -> Motions:
    """Motions of P candidates over `duration`, s, sampled every `step`, s; see `References`.

    Raises InputError where the system has no controller, or an effect with internal states.
    """
    plant = Plant(system)
    if system.controller is None:
        raise InputError(system.name, "controller", "no such table", "the gains with which the arm follows a reference")
    P = sine.shape[0]
    plant.controller = JointPD(system.controller, References(frequency, sine, cosine))
    steps = max(1, round(duration / step))
    flow = _Flow(plant, np.tile(plant.rest, (P, 1)))
    y = np.empty((P, steps + 1, plant.rest.size))
    y[:, 0] = flow.y
    with np.errstate(over="ignore", invalid="ignore"):  # of a motion that runs away
        for k in range(steps):
            flow.advance(duration / steps)
            y[:, k + 1] = flow.y
    t = np.linspace(0.0, duration, steps + 1)
    flat = y.reshape(-1, y.shape[2])
    x, v = plant.split(flat)
    torque = plant.torque(np.tile(t, P), flat)
    return Motions(t, *(part.reshape(P, steps + 1, -1) for part in (x, v, torque)))


class _Flow:
    """The present states y (P, n_y) and what the next step can use again; source of the method: see `integrate`."""

    def __init__(self, plant: Plant, y: Array) -> None:
        self._plant, self._method = plant, radau(STAGES)
        self.t, self.y = 0.0, y
        n, rates = plant.model.layout.n_x, y.shape[1] - plant.model.layout.n_x
        self._tolerance = np.concatenate((np.full(n, POSITION_TOLERANCE), np.full(rates, SPEED_TOLERANCE)))
        self._inverses: NDArray[np.complex128] | None = None
        self._step = 0.0
        self._increments = np.zeros((y.shape[0], STAGES, y.shape[1]))  # of the last step, which lasted as long

    def advance(self, h: float, halvings: int = 0) -> None:
        """Go on by h, s; candidates that cannot be followed become NaN."""
        for fresh in (False, True):
            if fresh or self._inverses is None or h != self._step:
                self._linearise(h)
            Z, left = self._stages(h)
            if (left < 1.0).all():
                break
        if not (left < 1.0).all() and halvings < HALVINGS:
            for _ in range(2):
                self.advance(0.5 * h, halvings + 1)
            return
        self.t += h
        self.y = np.where((left < 1.0)[:, None], self.y + Z[:, -1], np.nan)
        self._increments = Z

    def _linearise(self, h: float) -> None:
        _, jacobians = finite_difference_jacobians(self._plant.rate, self.t, self.y)
        jacobians = np.nan_to_num(jacobians, nan=0.0, posinf=0.0, neginf=0.0)
        shifts = (self._method.eigenvalues / h)[:, None, None] * np.eye(self.y.shape[1])
        self._inverses, self._step = np.asarray(np.linalg.inv(shifts - jacobians[:, None]), dtype=np.complex128), h

    def _stages(self, h: float) -> tuple[Array, Array]:
        """Increments (P, s, n_y) by simplified Newton iterations, and what the last changed over its tolerance (P,)."""
        method, (P, n) = self._method, self.y.shape
        assert self._inverses is not None
        t = np.tile(self.t + method.c * h, P)
        # The last step's polynomial goes on, which is as long where the Jacobians are those of this step.
        Z = method.onward(self._increments)
        left = np.full(P, np.inf)
        for _ in range(ITERATIONS):
            F = self._plant.rate(t, (self.y[:, None] + Z).reshape(-1, n)).reshape(Z.shape)
            change = method.newton_change(h, F, Z, self._inverses)
            Z = Z + change
            left = np.nan_to_num(np.abs(change / self._tolerance).max(axis=(1, 2)), nan=np.inf)
            left[np.isnan(self.y).any(axis=1)] = 0.0  # given up already
            if (left < 1.0).all():
                break
        return Z, left
