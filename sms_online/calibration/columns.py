"""Columns of weak-form rows for what the description may be wrong in: Y π + N ν = b.

A reading that is n(t) too large adds ∫ c n dt to Y π, with the c of `row_noise`, so that N = -∫ c n dt. A torque that
is read too large by n(t) adds ∫ φ n dt to b, so N. With the right geometry momentum and force are others by ∂P π and
∂G π, and N = -∫ (φ̇ ∂P + φ ∂G) dt π; so with more elements of a link. All are linear in ν, and hold to first order in
ν.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain

import numpy as np
from scipy.interpolate import make_interp_spline

from sms_online.calibration.channels import (
    Family,
    Motion,
    TorqueFamily,
    low_pass_families,
    position_families,
    torque_families,
)
from sms_online.calibration.geometry import geometries
from sms_online.calibration.multiplied_noise import Multiplied
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
    positions = [each.nuisances for each in position_families(sensing, system.tolerances)]
    low_passes = [each.nuisances for each in low_pass_families(sensing, system.tolerances)]
    torques = [each.nuisances for each in torque_families(sensing, system.tolerances)]
    channels = chain.from_iterable((*positions, *low_passes, *torques))
    return (*channels, *(each.nuisance for each in geometries(system)), *truncations(system))


def _multiplied(families: Sequence[Family | TorqueFamily]) -> Iterator[Multiplied]:
    """What nuisances multiply, of families in the order of their columns."""
    first = 0
    for family in families:
        for k, chosen in enumerate(family.multiplies):
            of_torques = isinstance(family, TorqueFamily)
            yield Multiplied(first + k, () if of_torques else chosen, chosen if of_torques else ())
        first += len(family.nuisances)


def _interpolation(at: Indices, derivative: int = 0) -> Array:
    """Weights (STEPS + 1, at) of a spline through values at some instants, or of its slope, by instants."""
    fine = np.linspace(0.0, INSTANTS, STEPS + 1)
    return np.asarray(make_interp_spline(at, np.eye(at.size), DEGREE)(fine, derivative))


class CalibrationState(State):
    """What nuisances change at a segment's instants.

    From instant number `first` on: what a position sensor reads too much, added (K, sensors, ·), and what has that for
    its rate, before (K, sensors, ·); what a torque reads too much, torque (K, joints, ·); and by what another geometry
    changes momentum and force (K, n_v, ·), and more elements both (K, 2, n_v, ·), each by nuisance.
    """

    first: int
    added: Array
    before: Array
    torque: Array
    momentum: Array
    force: Array
    truncation: Array


class CalibrationColumns(Stage):
    """Evaluates the columns window by window, at the instants of the sensitivities.

    count: of nuisances. geometries: those of geometry, which come last but for those of truncation. multiplied: what
    nuisances multiply.
    """

    def __init__(self, model: Model, sensing: Sensing, span: float) -> None:
        self.count = len(nuisances(sensing))
        self._model, self._sensing = model, sensing
        self._positions = position_families(sensing, sensing.model.system.tolerances)
        self._low_passes = low_pass_families(sensing, sensing.model.system.tolerances)
        self._torques = torque_families(sensing, sensing.model.system.tolerances)
        self.multiplied = tuple(_multiplied([*self._positions, *self._low_passes, *self._torques]))
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
        layout = self._model.layout
        sensors = len(self._sensing.position_columns)
        families = (self._positions, self._low_passes, self._torques)
        widths = [sum(len(each.nuisances) for each in family) for family in families]
        moved = self.count - sum(widths) - self._truncation.count
        self._truncation.begin_segment()
        self.state = CalibrationState(
            next_instant,
            np.empty((0, sensors, widths[0])),
            np.empty((0, sensors, widths[1])),
            np.empty((0, len(layout.q), widths[2])),
            np.empty((0, layout.n_v, moved)),
            np.empty((0, layout.n_v, moved)),
            np.empty((0, 2, layout.n_v, self._truncation.count)),
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
        momentum, force = by_geometry
        now = self.state
        again, truncation = self._truncation.extend(pi, x, v, signals)
        now.truncation = np.concatenate((now.truncation[: len(now.truncation) - again], truncation))
        now.added = np.concatenate((now.added, self._sum_of(self._positions, motion, now.added)))
        now.before = np.concatenate((now.before, self._sum_of(self._low_passes, motion, now.before)))
        now.torque = np.concatenate((now.torque, self._sum_of(self._torques, motion, now.torque)))
        now.momentum = np.concatenate((now.momentum, momentum))
        now.force = np.concatenate((now.force, force))

    @staticmethod
    def _sum_of(families: Sequence[Family] | Sequence[TorqueFamily], motion: Motion, like: Array) -> Array:
        """What families add, side by side (K, sensors or joints, ·), as in an array of before."""
        none = np.empty((len(motion.readings), like.shape[1], 0))
        return np.concatenate((none, *(family.adds(motion) for family in families)), axis=2)

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

        rough (W, STEPS + 1, n_v, sensors): what rough forces add to c.
        """
        W, _, n_v, sensors = sensitivity.H.shape
        if not self.count:
            return np.empty((W, n_v, 0))
        now, inside = self.state, (starts - self.state.first)[:, None] + np.arange(INSTANTS + 1)
        parts = np.concatenate((sensitivity.H, sensitivity.P_x, sensitivity.G_v, sensitivity.G_x), axis=1)
        parts, rough = parts.reshape(W, -1, n_v * sensors), rough.reshape(W, STEPS + 1, -1)
        positions = []
        for kernels, to_steps, read in (
            (self._kernels, self._to_steps, now.added),
            (self._rate_kernels, self._rate_to_steps, now.before),
        ):
            if not read.shape[2]:
                continue
            weights = kernels[sensitivity.offset] @ parts
            if rough.any():
                weights += to_steps.T @ rough
            flat = weights.reshape(W, -1, n_v, sensors).swapaxes(1, 2).reshape(W, n_v, -1)
            positions.append(-flat @ read[inside].reshape(W, flat.shape[2], -1))
        torques = np.zeros((W, n_v, now.torque.shape[2]))
        torques[:, self._joint_rows] = self._over(self._phi, now.torque[inside])
        moved = -self._over(self._phi_dot, now.momentum[inside]) - self._over(self._phi, now.force[inside])
        momentum, force = now.truncation[inside].swapaxes(0, 2).swapaxes(1, 2)
        finer = -self._over(self._phi_dot, momentum) - self._over(self._phi, force)
        return np.concatenate((*positions, torques, moved, finer), axis=2)

    @staticmethod
    def _over(weights: Array, values: Array) -> Array:
        """Sums (W, …) over the instants of values (W, INSTANTS + 1, …)."""
        return np.asarray((weights @ values.reshape(*values.shape[:2], -1)).reshape(len(values), *values.shape[2:]))

    def drop(self, before: int) -> None:
        """Forget instants with smaller numbers."""
        if self.count:
            kept = slice(before - self.state.first, None)
            self.state.added, self.state.before = self.state.added[kept], self.state.before[kept]
            self.state.torque = self.state.torque[kept]
            self.state.momentum, self.state.force = self.state.momentum[kept], self.state.force[kept]
            self.state.truncation = self.state.truncation[kept]
        self.state.first = before
