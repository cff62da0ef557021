"""Columns of weak-form rows for what the description may be wrong in: Y π + N ν = b.

A reading that is n(t) too large adds ∫ c n dt to Y π, with the c of `row_noise`, so that N = -∫ c n dt. A torque that
is read too large by n(t) adds ∫ φ n dt to b, so N. With the right geometry momentum and force are others by ∂P π and
∂G π, and N = -∫ (φ̇ ∂P + φ ∂G) dt π; so with more elements of a link. All are linear in ν, and hold to first order in
ν.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_interp_spline

from sms_online.calibration.channels import Families, Motion, added, nuisances_of
from sms_online.calibration.geometry import geometries
from sms_online.calibration.nuisance import Nuisance
from sms_online.calibration.truncation import Truncation, truncations
from sms_online.model.model import Model
from sms_online.pipeline.momentum_windows import EXPONENT, INSTANTS, STEPS
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensitivity import SPARSE, Sensitivity, nodes
from sms_online.pipeline.weak_form import test_function
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices

# Degree of splines between instants: of a vibration of 10 Hz, 50 times a second, it loses a thousandth, a cubic a
# thirtieth.
DEGREE = 7


def nuisances(sensing: Sensing) -> tuple[Nuisance, ...]:
    """What a session's description may be wrong in, in the order of its columns."""
    system = sensing.model.system
    of_geometry = (each.nuisance for each in geometries(system))
    return (*Families.of(sensing).nuisances, *of_geometry, *truncations(system))


def _interpolation(at: Indices, derivative: int = 0) -> Array:
    """Weights (STEPS + 1, at) of a spline through values at some instants, or of its slope, by instants."""
    fine = np.linspace(0.0, INSTANTS, STEPS + 1)
    return np.asarray(make_interp_spline(at, np.eye(at.size), DEGREE)(fine, derivative))


class CalibrationState(State):
    """What nuisances change at a segment's instants, from number `first` on, each by nuisance.

    read: what a position sensor reads too much (K, sensors, ·), what has that for its rate (K, sensors, ·), and what a
    torque reads too much (K, joints, ·). moved: by what another geometry changes momentum and force (K, 2, n_v, ·), and
    by what more elements do.
    """

    first: int
    read: list[Array]
    moved: list[Array]


class CalibrationColumns(Stage):
    """Evaluates the columns window by window, at the instants of the sensitivities.

    count: of nuisances. geometries: those of geometry, which come last but for those of truncation. multiplied: what
    nuisances multiply.
    """

    def __init__(self, model: Model, sensing: Sensing, span: float) -> None:
        self.count = len(nuisances(sensing))
        self._model, self._sensing = model, sensing
        families = Families.of(sensing)
        self.multiplied = families.multiplied
        sensors = len(sensing.position_columns)
        # Families with the number of readings that they add to.
        self._read = (
            (families.positions, sensors), (families.low_passes, sensors), (families.torques, len(model.layout.q))
        )  # fmt: skip
        # Of the session's system: an event's may hold more that has a geometry.
        self.geometries = tuple(geometries(sensing.model.system))
        self._truncation = Truncation(model, span / INSTANTS)
        self._joint_rows = list(model.layout.theta_m)
        # What is added at the instants, in the sum over steps; and that sum of c, by parts of a `Sensitivity`.
        self._to_steps = _interpolation(np.arange(INSTANTS + 1)) * span / STEPS
        self._rate_to_steps = _interpolation(np.arange(INSTANTS + 1), 1) * INSTANTS / STEPS
        steps = [self._kernel(offset, span) for offset in range(SPARSE)]
        self._kernels = [self._to_steps.T @ kernel for kernel in steps]
        self._rate_kernels = [self._rate_to_steps.T @ kernel for kernel in steps]
        phi, phi_dot, _ = test_function(INSTANTS, span, EXPONENT)
        self._phi, self._phi_dot = phi * span / INSTANTS, phi_dot * span / INSTANTS
        self.forget(0)

    def forget(self, next_instant: int) -> None:
        """Begin anew: `next_instant` is the number of the first one to come."""
        self._truncation.begin_segment()
        moved = (len(self.geometries), self._truncation.count)
        self.state = CalibrationState(
            next_instant,
            [np.empty((0, width, len(nuisances_of(families)))) for families, width in self._read],
            [np.empty((0, 2, self._model.layout.n_v, count)) for count in moved],
        )

    def extend(self, pi: Array, x: Array, v: Array, signals: Array, rates: Array, by_geometry: Array) -> None:
        """Take the next instants: x (K, n_x), v and signals as in `Instants`, rates (K, sensors) of the readings.

        by_geometry (2, K, n_v, c): what geometries change momentum and force by, with parameters π.
        """
        if not self.count:
            return
        torque = signals[:, : len(self._model.layout.q)]
        _, T_0 = self._model.layout.base_pose(x)
        motion = Motion(self._sensing.readings(x), rates, torque, T_0)
        now = self.state
        again, by_truncation = self._truncation.extend(pi, x, v, signals)
        fresh = [added(families, motion, width) for families, width in self._read]
        now.read = [np.concatenate(pair) for pair in zip(now.read, fresh, strict=True)]
        geometry, truncation = now.moved
        truncation = truncation[: len(truncation) - again]
        now.moved = [
            np.concatenate((geometry, by_geometry.swapaxes(0, 1))),
            np.concatenate((truncation, by_truncation)),
        ]

    def _kernel(self, offset: int, span: float) -> Array:
        """Weights (STEPS + 1, ·) of H, ∂Pπ/∂x, ∂Gπ/∂v and ∂Gπ/∂x in the integral of c times what is added.

        As `RowNoise._kernel_weights`, but by splines: noise is known to a tenth, these are to be known to a thousandth.
        """
        phi, phi_dot, phi_ddot = (part[:, None] for part in test_function(STEPS, span, EXPONENT))
        every, some, per_second = np.arange(INSTANTS + 1), nodes(offset), INSTANTS / span
        of_mass = phi_ddot * _interpolation(every) + phi_dot * _interpolation(every, 1) * per_second
        sparse, slope = _interpolation(some), _interpolation(some, 1) * per_second
        of_force = (-phi_dot * sparse, phi_dot * sparse + phi * slope, -phi * sparse)
        return np.concatenate((of_mass, *of_force), axis=1)

    def windows(self, starts: Indices, sensitivity: Sensitivity, rough: Array) -> Array:
        """N (W, n_v, count) of the windows that start at some instants.

        rough (W, STEPS + 1, n_v, sensors): what rough forces add to c, of slow displacements.
        """
        W, _, n_v, sensors = sensitivity.H.shape
        if not self.count:
            return np.empty((W, n_v, 0))
        now, inside = self.state, (starts - self.state.first)[:, None] + np.arange(INSTANTS + 1)
        parts = np.concatenate((sensitivity.H, sensitivity.P_x, sensitivity.G_v, sensitivity.G_x), axis=1)
        parts, rough = parts.reshape(W, -1, n_v * sensors), rough.reshape(W, STEPS + 1, -1)
        out = []
        position, position_rate, torque = now.read
        for kernels, to_steps, read in (
            (self._kernels, self._to_steps, position),
            (self._rate_kernels, self._rate_to_steps, position_rate),
        ):
            if not read.shape[2]:
                continue
            weights = kernels[sensitivity.offset] @ parts
            if rough.any():
                weights += to_steps.T @ rough
            flat = weights.reshape(W, -1, n_v, sensors).swapaxes(1, 2).reshape(W, n_v, -1)
            out.append(-flat @ read[inside].reshape(W, flat.shape[2], -1))
        torques = np.zeros((W, n_v, torque.shape[2]))
        torques[:, self._joint_rows] = self._over(self._phi, torque[inside])
        changes = [np.moveaxis(each[inside], 2, 0) for each in now.moved]
        moved = [-self._over(self._phi_dot, momentum) - self._over(self._phi, force) for momentum, force in changes]
        return np.concatenate((*out, torques, *moved), axis=2)

    @staticmethod
    def _over(weights: Array, values: Array) -> Array:
        """Sums (W, …) over the instants of values (W, INSTANTS + 1, …)."""
        return np.asarray((weights @ values.reshape(*values.shape[:2], -1)).reshape(len(values), *values.shape[2:]))

    def drop(self, before: int) -> None:
        """Forget instants with smaller numbers."""
        if self.count:
            kept = slice(before - self.state.first, None)
            self.state.read = [each[kept] for each in self.state.read]
            self.state.moved = [each[kept] for each in self.state.moved]
        self.state.first = before
