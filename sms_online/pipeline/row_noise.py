"""Noise of weak-form rows, propagated from the sensors.

A row's error is linear in the noise n(t) of the positions: ∫ c(t) n(t) dt with
c = φ̈ H + φ̇ (Ḣ + ∂Gπ/∂v - ∂Pπ/∂x) + φ (d/dt ∂Gπ/∂v - ∂Gπ/∂x), P π = H v the momentum and G π the force of the
balance; ∫ φ n_τ dt from the noise of the torque; and ∫ φ Jᵀ n_w dt from that of a measured wrench, J in the middle
of the window. White noise of 1σ per sample has the density σ² T_s. Rows of
windows that overlap share noise, so their covariance is block-banded; see `whitening`.

An unknown force, such as stiction at a standstill, is a common error of all windows that include it. It enters their
covariances, so what the windows hold beside it is still informative.

Devices with clocks of their own are all a little early or late against each other, by the same for seconds. Over a
window that is an error of the row in proportion to the rates of that device's readings.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from sms_online.pipeline.latency import SourceGroup
from sms_online.pipeline.momentum_windows import EXPONENT, HOPS, INSTANTS, STEPS, STEPS_A_HOP
from sms_online.pipeline.sensitivity import SPARSE, Sensitivity, nodes
from sms_online.pipeline.stamp_jitter import Jitter
from sms_online.pipeline.weak_form import test_function
from sms_online.state import Stage, State
from sms_online.stream import Array

# Share of the variance by sensors that is added to a row alone, for the rounding of the factorisation.
OWN_SHARE = 1e-7
# What the clock of a device is off by, 1σ, s, when it has been watched for CLOCK_KNOWN, s, and before. The line behind
# it is fitted to the least delayed samples, which reach the loop some 100 µs late, give or take 50; few give less.
CLOCK_ERROR, YOUNG_CLOCK_ERROR, CLOCK_KNOWN = 5e-5, 1e-4, 10.0


class RowNoiseState(State):
    """What is kept of the last windows.

    Of the last windows: kernel by time (·, n_v), density of torques (joints,), lateness by clock (n_v, clocks), and
    deviation by unknown forces (INSTANTS, n_v). wrench (n_v, components): by white noise of measured wrenches.
    """

    before: list[Array] = msgspec.field(default_factory=list)
    torque: list[Array] = msgspec.field(default_factory=list)
    late: list[Array] = msgspec.field(default_factory=list)
    free: list[Array] = msgspec.field(default_factory=list)
    wrench: list[Array] = msgspec.field(default_factory=list)


class RowNoise(Stage):
    """Covariance of each window's rows with those of the windows before it.

    joint_rows: rows that hold each joint's torque. clocks: what comes by each clock; the rest is as late as the grid.
    """

    def __init__(self, joint_rows: tuple[int, ...], span: float, clocks: Sequence[SourceGroup] = ()) -> None:
        self._joint_rows = list(joint_rows)
        self._clocks = [(list(clock.sensors), [joint_rows[i - 1] for i in clock.joints]) for clock in clocks]
        self._step = span / STEPS
        self._phi, self._phi_dot, self._phi_ddot = test_function(STEPS, span, EXPONENT)
        self._weights = [self._kernel_weights(offset, span) for offset in range(SPARSE)]
        # ∫ φ(t) φ(t + k hops) dt.
        shifted = [self._phi[: STEPS + 1 - k * STEPS_A_HOP] @ self._phi[k * STEPS_A_HOP :] for k in range(HOPS)]
        self._overlap = self._step * np.array(shifted)
        self.state = RowNoiseState()

    def _kernel_weights(self, offset: int, span: float) -> Array:
        """Weights (STEPS + 1, ·) that make c out of H, Ḣ, ∂Pπ/∂x, ∂Gπ/∂v and ∂Gπ/∂x where they are computed."""
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

    def kernels(self, windows: Sensitivity) -> Array:
        """Responses of rows to displacements of the sensors.

        c (W, STEPS + 1, n_v, sensors): what a displacement n(t) of each sensor adds to the rows is ∫ c(t) n(t) dt.

        But for rough forces, which see the motion through the filter: `RoughForces.kernels`.
        """
        parts = (windows.H, windows.H_dot, windows.P_x, windows.G_v, windows.G_x)
        W, _, n_v, sensors = windows.H.shape
        stacked = np.concatenate(parts, axis=1).reshape(W, -1, n_v * sensors)
        return np.asarray((self._weights[windows.offset] @ stacked).reshape(W, STEPS + 1, n_v, sensors))

    def lateness(self, kernels: Array, rates: Array) -> Array:
        """What a second of delay of each sensor adds to the rows (W, n_v, sensors).

        rates (W, INSTANTS + 1, sensors): of the readings.
        """
        # Every other step lies between two instants and counts half for each.
        weights = kernels[:, ::2].copy()
        weights[:, :-1] += 0.5 * kernels[:, 1::2]
        weights[:, 1:] += 0.5 * kernels[:, 1::2]
        return np.asarray(self._step * np.einsum("wkvs,wks->wvs", weights, rates))

    def jittering(self, kernels: Array, rates: Array, jitters: Sequence[Jitter]) -> Array:
        """c (W, STEPS + 1, n_v, ·) of a lateness δ(t) of each device whose stamps jitter; rates as in `lateness`."""
        between = np.repeat(rates, 2, axis=1)[:, :-1]
        between[:, 1::2] = 0.5 * (rates[:, :-1] + rates[:, 1:])
        devices = [list(jitter.sensors) for jitter in jitters]
        each = [np.einsum("wkvs,wks->wkv", kernels[..., own], between[..., own]) for own in devices]
        return np.stack(each, axis=3) if each else kernels[..., :0]

    def covariances(
        self, kernels: Array, late: Array, sensor_density: Array, torque_density: Array, free: Array, ages: Array,
        wrench: Array | None = None,
    ) -> list[list[Array]]:  # fmt: skip
        """Covariances (n_v, n_v) of each of W windows in a row with those before, oldest first, then its own.

        In (N s)² and so on. kernels (W, STEPS + 1, n_v, sensors): c. late (W, n_v, sensors): `lateness`. sensor_density
        (sensors,): σ² T_s of each position sensor. torque_density (joints,): of n τ, (N m)² s. free (W, INSTANTS, n_v):
        deviation of what unknown forces add to each row in a half hop; no half hops where there are none in any window.
        ages (W,): of the clocks at the windows' ends, s. wrench (W, n_v, components): generalized forces of unit
        wrenches, times the root of their density.
        """
        W, _, n_v, sensors = kernels.shape
        now, past = self.state, len(self.state.before)
        # By time, so that what two windows have in common lies in one piece.
        c = np.multiply(kernels.swapaxes(2, 3), np.sqrt(self._step * sensor_density)[:, None], order="C")
        before = [*now.before, *c.reshape(W, -1, n_v)]  # many numbers, and so not copied
        torque = np.concatenate((*(each[None] for each in now.torque), np.tile(torque_density, (W, 1))))
        error = np.where(ages >= CLOCK_KNOWN, CLOCK_ERROR, YOUNG_CLOCK_ERROR)
        by_clock = np.concatenate((*(each[None] for each in now.late), error[:, None, None] * self._by_clock(late)))
        unknown = np.concatenate((*(each[None] for each in now.free), free))
        wrench = np.zeros((W, n_v, 0)) if wrench is None else wrench
        pushed = np.concatenate((*(each[None] for each in now.wrench), wrench))
        out: list[list[Array]] = [[] for _ in range(W)]
        length = len(before[-1])
        for hops in range(min(HOPS, past + W) - 1, -1, -1):  # from each window to a later one
            first = hops * STEPS_A_HOP * sensors
            later = np.arange(max(past, hops), past + W)
            own = np.empty((later.size, n_v, n_v))
            for block, k in zip(own, later.tolist(), strict=True):
                np.matmul(before[k][: length - first].T, before[k - hops][first:], out=block)
            shared = self._overlap[hops] * np.sqrt(torque_density * torque[later - hops])
            own[:, self._joint_rows, self._joint_rows] += shared
            if self._clocks:
                # What windows share fades out where they no longer overlap, for the covariance to stay banded.
                own += (1.0 - hops / HOPS) * (by_clock[later] @ by_clock[later - hops].swapaxes(1, 2))
            if wrench.shape[2]:
                own += self._overlap[hops] * (pushed[later] @ pushed[later - hops].swapaxes(1, 2))
            diagonal = np.einsum("wii->wi", own)
            if hops == 0:
                diagonal += OWN_SHARE * diagonal
            if free.shape[1]:
                diagonal += common(unknown[later], unknown[later - hops], hops)
            for k, block in zip((later - past).tolist(), own, strict=True):
                out[k].append(block)
        now.before, now.torque, now.late, now.free, now.wrench = (
            list(each[-(HOPS - 1) :]) for each in (before, torque, by_clock, unknown, pushed)
        )
        return out

    def _by_clock(self, late: Array) -> Array:
        """The same of each clock (W, n_v, clocks). All together being late changes nothing: so much do torques do."""
        columns = np.zeros((*late.shape[:2], len(self._clocks)))
        torque = -late.sum(axis=2)
        for k, (sensors, joint_rows) in enumerate(self._clocks):
            columns[..., k] += late[..., sensors].sum(axis=2)
            columns[:, joint_rows, k] += torque[:, joint_rows]
        return columns


def common(free: Array, before: Array, hops: int) -> Array:
    """Covariances (W, n_v) of windows with those that begin so many hops before, by unknown forces.

    As if these stayed for a half hop, in which the test functions of either change little.
    free, before (W, INSTANTS, n_v): see `RowNoise.covariances`.
    """
    later = hops * (INSTANTS // HOPS)
    return np.asarray(np.sum(free[:, : INSTANTS - later] * before[:, later:], axis=1))


def _interpolation(at: Array, nodes: Array) -> Array:
    """Weights (at, nodes) of linear interpolation, constant beyond the ends."""
    return np.stack([np.interp(at, nodes, unit) for unit in np.eye(nodes.size)], axis=1)
