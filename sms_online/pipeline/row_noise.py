"""Noise of weak-form rows, propagated from the sensors.

A row's error is linear in the noise n(t) of the positions: ∫ c(t) n(t) dt with
c = φ̈ H + φ̇ (Ḣ + ∂Gπ/∂v - ∂Pπ/∂x) + φ (d/dt ∂Gπ/∂v - ∂Gπ/∂x), P π = H v the momentum and G π the force of the
balance; and ∫ φ n_τ dt from the noise of the torque. White noise of 1σ per sample has the density σ² T_s. Rows of
windows that overlap share noise, so their covariance is block-banded; see `whitening`.

A force that nobody knows, as dry friction's at a standstill, is an error of all windows that see it: what it adds to
one says what it adds to the others, and what they hold beside it is still told.

Devices with clocks of their own are all a little early or late against each other, by the same for seconds. Over a
window that is an error of the row in proportion to the rates of that device's readings.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec
import numpy as np

from sms_online.pipeline.latency import SourceGroup
from sms_online.pipeline.momentum_windows import EXPONENT, HOPS, INSTANTS, STEPS
from sms_online.pipeline.sensitivity import SPARSE, Sensitivity, nodes
from sms_online.pipeline.weak_form import test_function
from sms_online.state import Stage, State
from sms_online.stream import Array

STEPS_A_HOP = STEPS // HOPS
# Share of the variance by sensors that is added to a row alone, for the rounding of the factorisation.
OWN_SHARE = 1e-7
# What the clock of a device is off by, 1σ, s, when it has been watched for CLOCK_KNOWN, s, and before. The line behind
# it is told by the least delayed samples, which reach the loop some 100 µs late, give or take 50; few tell less.
CLOCK_ERROR, YOUNG_CLOCK_ERROR, CLOCK_KNOWN = 5e-5, 1e-4, 10.0


class RowNoiseState(State):
    """What is kept of the last windows.

    Of the last windows: kernel by time (·, n_v), density of torques (joints,), lateness by clock (n_v, clocks), and
    deviation by unknown forces (INSTANTS, n_v).
    """

    before: list[Array] = msgspec.field(default_factory=list)
    torque: list[Array] = msgspec.field(default_factory=list)
    late: list[Array] = msgspec.field(default_factory=list)
    free: list[Array] = msgspec.field(default_factory=list)


class RowNoise(Stage):
    """Covariance of each window's rows with those of the windows before it.

    joint_rows: rows that hold each joint's torque. clocks: what comes by each clock; the rest is as late as the grid.
    late (n_v, sensors): what a second of delay of each sensor adds to the rows of the last window.
    """

    def __init__(self, joint_rows: tuple[int, ...], span: float, clocks: Sequence[SourceGroup] = ()) -> None:
        self._joint_rows = list(joint_rows)
        self._clocks = [(list(clock.sensors), [joint_rows[i - 1] for i in clock.joints]) for clock in clocks]
        self._step = span / STEPS
        self._phi, self._phi_dot, self._phi_ddot = test_function(STEPS, span, EXPONENT)
        self._weights = [self._told(offset, span) for offset in range(SPARSE)]
        # ∫ φ(t) φ(t + k hops) dt.
        shifted = [self._phi[: STEPS + 1 - k * STEPS_A_HOP] @ self._phi[k * STEPS_A_HOP :] for k in range(HOPS)]
        self._overlap = self._step * np.array(shifted)
        self.state = RowNoiseState()  # this window included
        self.late = np.empty((0, 0))

    def _told(self, offset: int, span: float) -> Array:
        """Weights (STEPS + 1, ·) that make c out of H, Ḣ, ∂Pπ/∂x, ∂Gπ/∂v and ∂Gπ/∂x where they are told."""
        steps, instants = np.arange(STEPS + 1.0), np.arange(0.0, STEPS + 1.0, STEPS // INSTANTS)
        dense = _interpolation(steps, instants)
        sparse = _interpolation(steps, instants[nodes(offset)])
        slope = dense @ np.gradient(sparse[:: STEPS // INSTANTS], span / INSTANTS, axis=0)
        phi, phi_dot, phi_ddot = self._phi[:, None], self._phi_dot[:, None], self._phi_ddot[:, None]
        of_force = (-phi_dot * sparse, phi_dot * sparse + phi * slope, -phi * sparse)
        return np.concatenate((phi_ddot * dense, phi_dot * dense, *of_force), axis=1)

    def begin_segment(self) -> None:
        """The next window shares no samples with those before."""
        self.state = RowNoiseState()

    def kernel(self, window: Sensitivity) -> Array:
        """c (STEPS + 1, n_v, sensors): what a displacement n(t) of each sensor adds to the rows is ∫ c(t) n(t) dt.

        But for rough forces, which see the motion through the filter: `RoughForces.kernel`.
        """
        parts = (window.H, window.H_dot, window.P_x, window.G_v, window.G_x)
        n_v, sensors = window.H.shape[1:]
        stacked = np.concatenate(parts).reshape(-1, n_v * sensors)
        return np.asarray((self._weights[window.offset] @ stacked).reshape(STEPS + 1, n_v, sensors))

    def covariance(
        self, kernel: Array, rates: Array, sensor_density: Array, torque_density: Array, free: Array,
        age: float = np.inf,
    ) -> list[Array]:  # fmt: skip
        """Covariances (n_v, n_v) with the windows before, oldest first, then the window's own; (N s)² and so on.

        kernel (STEPS + 1, n_v, sensors): c. rates (INSTANTS + 1, sensors): of the readings in the window.
        sensor_density (sensors,): σ² T_s of each position sensor. torque_density (joints,): of n τ, (N m)² s.
        free (INSTANTS, n_v): deviation of what unknown forces add to each row in a half hop; no half hops where there
        are none in any window. age: of the clocks at the window's end, s.
        """
        n_v, sensors = kernel.shape[1:]
        # By time, so that what two windows have in common lies in one piece.
        c = np.multiply(kernel.swapaxes(1, 2), np.sqrt(self._step * sensor_density)[:, None], order="C")
        c = c.reshape(-1, n_v)
        self.late = self._lateness(kernel, rates)
        late = (CLOCK_ERROR if age >= CLOCK_KNOWN else YOUNG_CLOCK_ERROR) * self._by_clock(self.late)
        now = self.state
        now.before = [*now.before, c][-HOPS:]
        now.torque = [*now.torque, torque_density][-HOPS:]
        now.late = [*now.late, late][-HOPS:]
        hops = np.arange(len(self.state.before) - 1, -1, -1)  # from each window to this one
        out = np.empty((hops.size, n_v, n_v))
        for block, other, first in zip(out, self.state.before, (hops * (STEPS_A_HOP * sensors)).tolist(), strict=True):
            np.matmul(c[: len(c) - first].T, other[first:], out=block)
        torque = np.sqrt(torque_density * np.array(self.state.torque))
        out[:, self._joint_rows, self._joint_rows] += self._overlap[hops, None] * torque
        if self._clocks:
            # What windows share fades out where they no longer overlap, for the covariance to stay banded.
            out += ((1.0 - hops / HOPS)[:, None, None] * late) @ np.array(self.state.late).swapaxes(1, 2)
        own = np.einsum("ii->i", out[-1])
        own += OWN_SHARE * own
        if len(free):
            now.free = [*now.free, free][-HOPS:]
            np.einsum("hii->hi", out)[:] += common(free, now.free)
        return list(out)

    def _lateness(self, kernel: Array, rates: Array) -> Array:
        """See `late`; rates (INSTANTS + 1, sensors): of the readings."""
        # Every other step stands between two instants and counts half for each.
        weights = kernel[::2].copy()
        weights[:-1] += 0.5 * kernel[1::2]
        weights[1:] += 0.5 * kernel[1::2]
        return np.asarray(self._step * np.einsum("kvs,ks->vs", weights, rates))

    def _by_clock(self, late: Array) -> Array:
        """The same of each clock (n_v, clocks). All together being late changes nothing: so much do torques do."""
        columns = np.zeros((len(late), len(self._clocks)))
        torque = -late.sum(axis=1)
        for column, (sensors, joint_rows) in zip(columns.T, self._clocks, strict=True):
            column += late[:, sensors].sum(axis=1)
            column[joint_rows] += torque[joint_rows]
        return columns


def common(free: Array, before: Iterable[Array]) -> Array:
    """Covariances (windows, n_v) of a window with each of `before`, it being the last, by forces that nobody knows.

    As if these stayed for a half hop, in which the test functions of either change little.
    free (INSTANTS, n_v): see `RowNoise.covariance`.
    """
    others = list(before)[::-1]
    instants = range(0, len(others) * (INSTANTS // HOPS), INSTANTS // HOPS)  # by which this one begins later
    found = [np.sum(free[: INSTANTS - k] * other[k:], axis=0) for k, other in zip(instants, others, strict=True)]
    return np.array(found[::-1])


def _interpolation(at: Array, nodes: Array) -> Array:
    """Weights (at, nodes) of linear interpolation, constant beyond the ends."""
    return np.stack([np.interp(at, nodes, unit) for unit in np.eye(nodes.size)], axis=1)
