"""How momentum and force of the weak form answer to small displacements and speeds, along a session's motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_online.model.dynamics import Dynamics
from sms_online.model.model import Model
from sms_online.pipeline.momentum_windows import INSTANTS, Columns, Instants
from sms_online.state import Stage, State
from sms_online.stream import Array

# Step of the differences that give derivatives: 1e-8 of their size is lost to curvature, as much to rounding.
DIFFERENCE = 1e-6
# Derivatives of the force and of the momentum by displacements, which weigh little beside the mass matrix, are told at
# every other instant and interpolated: on the planar example with strong noise that costs 3 % in accuracy, telling them
# at every fourth one 17 %.
SPARSE = 2


@dataclass(frozen=True)
class Sensitivity:
    """Over a window of INSTANTS + 1 instants, for displacements that one unit of each position sensor's noise makes.

    H, H_dot (INSTANTS + 1, n_v, sensors): ∂Pπ/∂v and Ḣ. P_x, G_v, G_x (nodes, n_v, sensors): ∂Pπ/∂x, ∂Gπ/∂v, ∂Gπ/∂x at
    every other instant, the first of which is `offset` instants into the window. rates (INSTANTS + 1, sensors): of the
    readings. displacements (n_v, sensors): that unit noise makes in the middle of the window.
    """

    H: Array
    H_dot: Array
    P_x: Array
    G_v: Array
    G_x: Array
    offset: int
    rates: Array
    displacements: Array


def derivatives(dynamics: Dynamics, x: Array, v: Array, signals: Array | None = None) -> Array:
    """∂Pπ/∂x, ∂Gπ/∂v and ∂Gπ/∂x side by side (K, n_v, 3 n_v) at x (K, n_x), v (K, n_v).

    signals (K, joints + n_states): n τ, then internal states, for the effects that need them.
    """
    inputs = None if signals is None else dynamics.model.inputs(_around(signals, v.shape[1]))
    return _differences(*dynamics.momentum_and_force(*moved_states(dynamics.model, x, v), inputs), len(x))


def moved_states(model: Model, x: Array, v: Array) -> tuple[Array, Array]:
    """Positions and speeds at K states, then with each displacement, then with each speed changed: K (1 + 2 n_v)."""
    K, n_v = v.shape
    x_n, v_n = np.repeat(x, n_v, axis=0), np.repeat(v, n_v, axis=0)
    moved = DIFFERENCE * np.tile(np.eye(n_v), (K, 1))
    shifted = x_n + model.position_rate(x_n, moved)
    return np.concatenate((x, shifted, x_n)), np.concatenate((v, v_n, v_n + moved))


def _around(signals: Array, n_v: int) -> Array:
    """What does not move, at the states of `moved_states`."""
    repeated = np.repeat(signals, n_v, axis=0)
    return np.concatenate((signals, repeated, repeated))


def _differences(p: Array, g: Array, K: int) -> Array:
    """See `derivatives`, from P π and G π (K (1 + 2 n_v), n_v) at the states of `moved_states`."""
    n_v = p.shape[1]
    (p_0, p_x, _), (g_0, g_x, g_v) = (np.split(part, [K, K + K * n_v]) for part in (p, g))
    of = [part.reshape(K, n_v, n_v) - at[:, None] for part, at in ((p_x, p_0), (g_v, g_0), (g_x, g_0))]
    return np.asarray((np.concatenate(of, axis=1) / DIFFERENCE).swapaxes(1, 2))


def nodes(offset: int) -> NDArray[np.int64]:
    """Instants of a window that derivatives of the force are told at."""
    return np.arange(offset, INSTANTS + 1, SPARSE)


class SensitivityState(State):
    """What is kept of a segment's instants.

    first: number of the first instant kept. dense (K, n_v, n_v + n_x): H and readings at each instant; rates (K,
    n_x): of the readings. numbers: instants of the derivatives (·, n_v, 3 n_v).
    """

    first: int
    dense: Array
    rates: Array
    numbers: NDArray[np.int64]
    derivatives: Array


class Sensitivities(Stage):
    """Sensitivity at the instants of a segment, as far as windows still need them.

    readings: x (K, n_x) to displacements (K, n_v, sensors) that unit noise of each position sensor makes. half_hop: s
    between instants.
    """

    def __init__(self, model: Model, readings: Callable[[Array], Array], half_hop: float) -> None:
        self.model = model
        self._readings = readings
        # Central differences, one-sided at the ends, for a matrix that changes in time, per half hop.
        self._slope: Array = np.asarray(np.gradient(np.eye(INSTANTS + 1), axis=0)) / half_hop
        self._dynamics: Dynamics | None = None  # of the last π
        self.forget(0)

    def forget(self, next_instant: int) -> None:
        """Begin anew: `next_instant` is the number of the first one to be told."""
        n_v, n_x = self.model.layout.n_v, self.model.layout.n_x
        self.state = SensitivityState(
            first=next_instant,
            dense=np.empty((0, n_v, n_v + n_x)),
            rates=np.empty((0, n_x)),
            numbers=np.empty(0, dtype=np.int64),
            derivatives=np.empty((0, n_v, 3 * n_v)),
        )

    @property
    def next_instant(self) -> int:
        """Number of the instant after the last one told."""
        return self.state.first + len(self.state.dense)

    def probes(self, instants: Instants) -> tuple[Array, Array, Array]:
        """See `Probes`."""
        sparse = (instants.number + np.arange(len(instants.x))) % SPARSE == 0
        x, v = moved_states(self.model, instants.x[sparse], instants.v[sparse])
        return x, v, _around(instants.signals[sparse], v.shape[1])

    def tell(self, pi: Array, x: Array, v: Array, signals: Array, probed: Columns | None = None) -> None:
        """Take the next instants: x (K, n_x), v (K, n_v), signals as in `Instants`, with parameters π.

        probed: columns at their `probes`, where they are known already.
        """
        now = self.state
        if not len(x):
            return
        if self._dynamics is None or not np.array_equal(self._dynamics.pi, pi):
            self._dynamics = self.model.dynamics(pi)
        dynamics = self._dynamics
        numbers = self.next_instant + np.arange(len(x))
        sparse = numbers % SPARSE == 0
        readings = self._readings(x)
        now.dense = np.concatenate((now.dense, np.concatenate((dynamics.mass_matrix(x), readings), axis=2)))
        # The rates of the readings themselves, of which Euler parameters are one more than speeds.
        inverse = np.linalg.inv(readings) if v.shape[1] == readings.shape[2] else np.linalg.pinv(readings)
        now.rates = np.concatenate((now.rates, (inverse @ v[:, :, None])[:, :, 0]))
        if sparse.any():
            now.numbers = np.concatenate((now.numbers, numbers[sparse]))
            if probed is None:
                told = derivatives(dynamics, x[sparse], v[sparse], signals[sparse])
            else:
                told = _differences(probed[0] @ pi, probed[1] @ pi, int(np.count_nonzero(sparse)))
            now.derivatives = np.concatenate((now.derivatives, told))

    def rates(self, count: int) -> Array:
        """Rates of the readings (count, sensors) at the last instants."""
        return self.state.rates[len(self.state.rates) - count :]

    def window(self, start: int) -> Sensitivity:
        """At the instants from number `start` on."""
        n_v = self.model.layout.n_v
        inside = slice(start - self.state.first, start - self.state.first + INSTANTS + 1)
        H, readings = self.state.dense[inside, :, :n_v], self.state.dense[inside, :, n_v:]
        H_dot = (self._slope @ H.reshape(INSTANTS + 1, -1)).reshape(H.shape)
        offset = -start % SPARSE
        first = int(np.searchsorted(self.state.numbers, start))
        told = self.state.derivatives[first : first + nodes(offset).size]
        P_x, G_v, G_x = (told[:, :, k * n_v : (k + 1) * n_v] @ readings[nodes(offset)] for k in range(3))
        middle = readings[INSTANTS // 2]
        return Sensitivity(H @ readings, H_dot @ readings, P_x, G_v, G_x, offset, self.state.rates[inside], middle)

    def drop(self, before: int) -> None:
        """Forget instants with smaller numbers."""
        now = self.state
        now.dense, now.rates = (
            now.dense[before - now.first :],
            now.rates[before - now.first :],
        )
        now.first = before
        kept = now.numbers >= before
        now.numbers, now.derivatives = now.numbers[kept], now.derivatives[kept]
