"""Columns of weak-form rows for what the description may be wrong in: Y π + N ν = b.

A reading that is n(t) too large adds ∫ c n dt to Y π, with the c of `row_noise`, so that N = -∫ c n dt. A torque that
is read too large by n(t) adds ∫ φ n dt to b, so N. With the right geometry momentum and force are others by ∂P π and
∂G π, and N = -∫ (φ̇ ∂P + φ ∂G) dt π. All three are linear in ν, and hold to first order in ν.
"""

from __future__ import annotations

from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from sms_online.calibration.channels import Motion, position_families, torque_families
from sms_online.calibration.geometry import geometries
from sms_online.calibration.nuisance import Nuisance
from sms_online.model.model import Model
from sms_online.pipeline.momentum_windows import EXPONENT, INSTANTS, STEPS
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensitivity import SPARSE, Sensitivity, nodes
from sms_online.pipeline.weak_form import test_function
from sms_online.state import Stage, State
from sms_online.stream import Array

# Degree of splines between instants: of a vibration of 10 Hz, 50 times a second, it loses a thousandth, a cubic a
# thirtieth.
DEGREE = 7


def nuisances(sensing: Sensing) -> tuple[Nuisance, ...]:
    """What a session's description may be wrong in, in the order of its columns."""
    system = sensing.model.system
    positions = [each.nuisances for each in position_families(sensing, system.tolerances)]
    torques = [each.nuisances for each in torque_families(sensing, system.tolerances)]
    return (*chain.from_iterable((*positions, *torques)), *(each.nuisance for each in geometries(system)))


def _interpolation(at: NDArray[np.int64], derivative: int = 0) -> Array:
    """Weights (STEPS + 1, at) of a spline through values at some instants, or of its slope, by instants."""
    fine = np.linspace(0.0, INSTANTS, STEPS + 1)
    return np.asarray(make_interp_spline(at, np.eye(at.size), DEGREE)(fine, derivative))


class CalibrationState(State):
    """What nuisances change at a segment's instants.

    From instant number `first` on: what a position sensor reads too much, added (K, sensors, ·), a torque, torque
    (K, joints, ·), and by what another geometry changes momentum and force (K, n_v, ·), each by nuisance.
    """

    first: int
    added: Array
    torque: Array
    momentum: Array
    force: Array


class CalibrationColumns(Stage):
    """Evaluates the columns window by window, at the instants of the sensitivities.

    count: of nuisances. geometries: those of geometry, which come last.
    """

    def __init__(self, model: Model, sensing: Sensing, span: float) -> None:
        self.count = len(nuisances(sensing))
        self._model, self._sensing = model, sensing
        self._positions = position_families(sensing, sensing.model.system.tolerances)
        self._torques = torque_families(sensing, sensing.model.system.tolerances)
        # Of the session's system: an event's may hold more that has a geometry.
        self.geometries = tuple(geometries(sensing.model.system))
        self._joint_rows = list(model.layout.theta_m)
        # What is added at the instants, in the sum over steps; and that sum of c, by parts of a `Sensitivity`.
        self._to_steps = _interpolation(np.arange(INSTANTS + 1)) * span / STEPS
        self._kernels = [self._kernel(offset, span) for offset in range(SPARSE)]
        phi, phi_dot, _ = test_function(INSTANTS, span, EXPONENT)
        self._phi, self._phi_dot = phi * span / INSTANTS, phi_dot * span / INSTANTS
        self.forget(0)

    def forget(self, next_instant: int) -> None:
        """Begin anew: `next_instant` is the number of the first one to come."""
        layout = self._model.layout
        sensors = len(self._sensing.position_columns)
        widths = [sum(len(each.nuisances) for each in family) for family in (self._positions, self._torques)]
        moved = self.count - sum(widths)
        self.state = CalibrationState(
            next_instant,
            np.empty((0, sensors, widths[0])),
            np.empty((0, len(layout.q), widths[1])),
            *np.empty((2, 0, layout.n_v, moved)),
        )

    def extend(self, x: Array, signals: Array, rates: Array, by_geometry: Array) -> None:
        """Take the next instants: x (K, n_x), signals as in `Instants`, rates (K, sensors) of the readings.

        by_geometry (2, K, n_v, c): what geometries change momentum and force by.
        """
        if not self.count:
            return
        torque = signals[:, : len(self._model.layout.q)]
        _, T_0 = self._model.layout.base_pose(x)
        motion = Motion(self._sensing.readings(x), rates, torque, T_0)
        K = len(x)
        added = [np.empty((K, *self.state.added.shape[1:2], 0)), *(family.adds(motion) for family in self._positions)]
        torques = [np.empty((K, *self.state.torque.shape[1:2], 0)), *(family.adds(motion) for family in self._torques)]
        momentum, force = by_geometry
        self.state.added = np.concatenate((self.state.added, np.concatenate(added, axis=2)))
        self.state.torque = np.concatenate((self.state.torque, np.concatenate(torques, axis=2)))
        self.state.momentum = np.concatenate((self.state.momentum, momentum))
        self.state.force = np.concatenate((self.state.force, force))

    def _kernel(self, offset: int, span: float) -> Array:
        """Weights (INSTANTS + 1, ·) of H, ∂Pπ/∂x, ∂Gπ/∂v and ∂Gπ/∂x in the integral of c times what is added.

        As `RowNoise.kernel`, but by splines: noise is known to a tenth, these are to be known to a thousandth.
        """
        phi, phi_dot, phi_ddot = (part[:, None] for part in test_function(STEPS, span, EXPONENT))
        every, some, per_second = np.arange(INSTANTS + 1), nodes(offset), INSTANTS / span
        of_mass = phi_ddot * _interpolation(every) + phi_dot * _interpolation(every, 1) * per_second
        sparse, slope = _interpolation(some), _interpolation(some, 1) * per_second
        of_force = (-phi_dot * sparse, phi_dot * sparse + phi * slope, -phi * sparse)
        return np.asarray(self._to_steps.T @ np.concatenate((of_mass, *of_force), axis=1))

    def windows(self, starts: NDArray[np.int64], sensitivity: Sensitivity, rough: Array) -> Array:
        """N (W, n_v, count) of the windows that start at some instants.

        rough (W, STEPS + 1, n_v, sensors): what rough forces add to c.
        """
        W, _, n_v, sensors = sensitivity.H.shape
        if not self.count:
            return np.empty((W, n_v, 0))
        now, inside = self.state, (starts - self.state.first)[:, None] + np.arange(INSTANTS + 1)
        parts = np.concatenate((sensitivity.H, sensitivity.P_x, sensitivity.G_v, sensitivity.G_x), axis=1)
        weights = self._kernels[sensitivity.offset] @ parts.reshape(W, -1, n_v * sensors)
        if rough.any():
            weights += self._to_steps.T @ rough.reshape(W, STEPS + 1, -1)
        flat = weights.reshape(W, -1, n_v, sensors).swapaxes(1, 2).reshape(W, n_v, -1)
        positions = -flat @ now.added[inside].reshape(W, flat.shape[2], -1)
        torques = np.zeros((W, n_v, now.torque.shape[2]))
        torques[:, self._joint_rows] = self._over(self._phi, now.torque[inside])
        moved = -self._over(self._phi_dot, now.momentum[inside]) - self._over(self._phi, now.force[inside])
        return np.concatenate((positions, torques, moved), axis=2)

    @staticmethod
    def _over(weights: Array, values: Array) -> Array:
        """Sums (W, …) over the instants of values (W, INSTANTS + 1, …)."""
        return np.asarray((weights @ values.reshape(*values.shape[:2], -1)).reshape(len(values), *values.shape[2:]))

    def drop(self, before: int) -> None:
        """Forget instants with smaller numbers."""
        if self.count:
            kept = slice(before - self.state.first, None)
            self.state.added, self.state.torque = self.state.added[kept], self.state.torque[kept]
            self.state.momentum, self.state.force = self.state.momentum[kept], self.state.force[kept]
        self.state.first = before
