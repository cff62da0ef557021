"""Sensitivity of the weak form's momentum and force to small displacements and speeds, along a session's motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.calibration.geometry import Geometry
from sms_online.model.dynamics import Dynamics
from sms_online.model.model import Model
from sms_online.pipeline.derivatives import Derivatives
from sms_online.pipeline.momentum_windows import INSTANTS
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices

# Derivatives of the force and of the momentum by displacements, small beside the mass matrix, are computed at
# every other instant and interpolated: on the planar example with strong noise that costs 3 % in accuracy, doing so
# at every fourth one 17 %.
SPARSE = 2


@dataclass(frozen=True)
class Sensitivity:
    """Over W windows of INSTANTS + 1 instants, for displacements that one unit of each position sensor's noise makes.

    H, H_dot (W, INSTANTS + 1, n_v, sensors): ∂Pπ/∂v and Ḣ. P_x, G_v, G_x (W, nodes, n_v, sensors): ∂Pπ/∂x, ∂Gπ/∂v,
    ∂Gπ/∂x at every other instant, the first of which is `offset` instants into a window. rates (W, INSTANTS + 1,
    sensors): of the readings. displacements (W, n_v, sensors): that unit noise makes in the middle of a window.
    """

    H: Array
    H_dot: Array
    P_x: Array
    G_v: Array
    G_x: Array
    offset: int
    rates: Array
    displacements: Array


def nodes(offset: int) -> Indices:
    """Instants of a window at which derivatives of the force are computed."""
    return np.arange(offset, INSTANTS + 1, SPARSE)


class SensitivityState(State):
    """What is kept of a segment's instants.

    first: number of the first instant kept. dense (K, n_v, n_v + n_x): H and readings at each instant; rates (K,
    n_x): of the readings. numbers: instants of the derivatives (·, n_v, 3 n_v).
    """

    first: int
    dense: Array
    rates: Array
    numbers: Indices
    derivatives: Array


class Sensitivities(Stage):
    """Sensitivity at the instants of a segment, as far as windows still need them.

    readings: x (K, n_x) to displacements (K, n_v, sensors) that unit noise of each position sensor makes. half_hop: s
    between instants. geometries: whose derivatives are wanted, too.
    """

    def __init__(
        self,
        model: Model,
        readings: Callable[[Array], Array],
        half_hop: float,
        geometries: Sequence[Geometry] = (),
    ) -> None:
        self.model = model
        self._derivatives = Derivatives(model, geometries)
        self._readings = readings
        # Central differences, one-sided at the ends, for a matrix that changes in time, per half hop.
        self._slope: Array = np.asarray(np.gradient(np.eye(INSTANTS + 1), axis=0)) / half_hop
        self._dynamics: Dynamics | None = None  # of the last π
        self.forget(0)

    def forget(self, next_instant: int) -> None:
        """Begin anew: `next_instant` is the number of the first one to come."""
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
        """Number of the instant after the last one taken."""
        return self.state.first + len(self.state.dense)

    def extend(self, pi: Array, x: Array, v: Array, signals: Array) -> Array:
        """Take the next instants: x (K, n_x), v (K, n_v), signals (K, n_signals), with parameters π.

        What geometries change momentum and force by there (2, K, n_v, c).
        """
        now = self.state
        if self._dynamics is None or not np.array_equal(self._dynamics.pi, pi):
            self._dynamics = self.model.dynamics(pi)
        numbers = self.next_instant + np.arange(len(x))
        sparse = numbers % SPARSE == 0
        readings, H = self._readings(x), self._dynamics.mass_matrix(x)
        now.dense = np.concatenate((now.dense, np.concatenate((H, readings), axis=2)))
        # The rates of the readings themselves, of which Euler parameters are one more than speeds.
        inverse = np.linalg.inv(readings) if v.shape[1] == readings.shape[2] else np.linalg.pinv(readings)
        now.rates = np.concatenate((now.rates, (inverse @ v[:, :, None])[:, :, 0]))
        derivatives, by_geometry = self._derivatives.at(pi, x, v, signals, H, sparse)
        now.numbers = np.concatenate((now.numbers, numbers[sparse]))
        now.derivatives = np.concatenate((now.derivatives, derivatives))
        return by_geometry

    @property
    def sensors(self) -> int:
        """Number of position sensors."""
        return int(self.state.rates.shape[1])

    def rates(self, count: int) -> Array:
        """Rates of the readings (count, sensors) at the last instants."""
        return self.state.rates[len(self.state.rates) - count :]

    def windows(self, starts: Indices) -> Sensitivity:
        """At the instants from each of some numbers on, all of them even or all of them odd."""
        n_v, now = self.model.layout.n_v, self.state
        inside = (starts - now.first)[:, None] + np.arange(INSTANTS + 1)
        dense = now.dense[inside]
        H, readings = dense[..., :n_v], dense[..., n_v:]
        H_dot = (self._slope @ H.reshape(len(starts), INSTANTS + 1, -1)).reshape(H.shape)
        offset = int(-starts[0] % SPARSE)
        at = nodes(offset)
        derivatives = now.derivatives[np.searchsorted(now.numbers, starts)[:, None] + np.arange(at.size)]
        P_x, G_v, G_x = (derivatives[..., k * n_v : (k + 1) * n_v] @ readings[:, at] for k in range(3))
        middle = readings[:, INSTANTS // 2]
        return Sensitivity(H @ readings, H_dot @ readings, P_x, G_v, G_x, offset, now.rates[inside], middle)

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
