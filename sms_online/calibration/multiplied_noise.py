"""Noise that a nuisance multiplies: the column of a gain holds the noise of the very rows that it is fitted to.

What a torque or a camera reads too large by is its reading times a gain, and the reading holds noise n, which is in the
row's residual r too. With the column as it is, least squares take E[N r] = var n in every row for a gain, however the
arm moves. N - E[n | r] is as good a column of the gain, and does not correlate with r.
Source: Carroll, Ruppert, Stefanski and Crainiceanu, Measurement Error in Nonlinear Models, 2006, ch. 4 (regression
calibration).

How much of a whitened row's variance is of n follows from synthetic noise of the same sensors, whitened like the rows.
Where the residual is far more than noise, as in first windows, nothing follows from it. There var n itself is taken off
the products Nᵀ N and Nᵀ b of the normal equations (ibid., ch. 5 and 7, corrected scores).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.pipeline.momentum_windows import EXPONENT, STEPS, STEPS_A_HOP
from sms_online.pipeline.weak_form import test_function
from sms_online.state import Stage, State
from sms_online.stream import Array

# Deviations of a row that noise makes.
LARGEST = 4.0
# Samples of the noise: what share of a row's variance it is follows from the mean of their squares.
SAMPLES = 8
# The synthetic noise is the same in every session, so that the same samples give the same bits.
SEED = 11


@dataclass(frozen=True)
class Multiplied:
    """What nuisance number `column` multiplies: position sensors by their number, or torques by their joint's.

    column: None where what multiplies them is no nuisance, but a candidate of a diagnosis.
    """

    column: int | None
    sensors: tuple[int, ...] = ()
    joints: tuple[int, ...] = ()

    @property
    def places(self) -> tuple[str, ...]:
        """The joints as a system file calls them."""
        return tuple(f"joint_{i + 1}" for i in self.joints)


class MultipliedNoiseState(State):
    """random: gives the noise. steps (·, sensors + joints): of unit variance, of the time that the next one shares."""

    random: np.random.Generator
    steps: Array


class MultipliedNoise(Stage):
    """Rows of synthetic noise of what nuisances multiply. joint_rows: rows that hold each joint's torque."""

    def __init__(self, multiplied: Sequence[Multiplied], sensors: int, joint_rows: Sequence[int], span: float) -> None:
        self._multiplied, self._sensors, self._joint_rows = tuple(multiplied), sensors, list(joint_rows)
        self._step = span / STEPS
        self._phi = test_function(STEPS, span, EXPONENT)[0]
        self.begin_segment()

    def begin_segment(self) -> None:
        """The next window shares no samples with those before."""
        none = np.empty((0, self._sensors + len(self._joint_rows), SAMPLES))
        self.state = MultipliedNoiseState(np.random.default_rng(SEED), none)

    def push(self, kernels: Array, sensor_density: Array, torque_density: Array) -> Array:
        """Samples of what the noise of each nuisance's readings adds to the rows of the next windows.

        (W, n_v, nuisances, SAMPLES).

        kernels (W, STEPS + 1, n_v, sensors), sensor_density (sensors,), torque_density (joints,): see
        `RowNoise.covariances`.
        """
        W, _, n_v, sensors = kernels.shape
        out = np.zeros((W, n_v, len(self._multiplied), SAMPLES))
        if not (W and self._multiplied):
            return out
        now = self.state
        missing = STEPS + 1 + (W - 1) * STEPS_A_HOP - len(now.steps)
        steps = np.concatenate((now.steps, now.random.standard_normal((missing, *now.steps.shape[1:]))))
        now.steps = steps[W * STEPS_A_HOP :]
        size = np.sqrt(self._step * np.concatenate((sensor_density, torque_density)))
        at = STEPS_A_HOP * np.arange(W)[:, None] + np.arange(STEPS + 1)
        noise = steps[at] * size[:, None]  # (W, STEPS + 1, sensors + joints, SAMPLES)
        torque = np.tensordot(noise[:, :, sensors:], self._phi, (1, 0))
        for column, each in zip(out.transpose(2, 0, 1, 3), self._multiplied, strict=True):
            if each.sensors:
                seen = list(each.sensors)
                column -= np.einsum("wkvs,wksc->wvc", kernels[..., seen], noise[:, :, seen], optimize=True)
            for i in each.joints:
                column[:, self._joint_rows[i]] += torque[:, i]
        return out


class SharesState(State):
    """Sums of squares of residuals over windows (n_v,), and how many windows."""

    residual: Array
    windows: Array


class Shares(Stage):
    """Takes off the columns of nuisances what a row's residual says of the noise that they multiply."""

    def __init__(self, columns: Sequence[int], n_v: int) -> None:
        self._columns = list(columns)
        self._n_v = n_v
        self.begin()

    def begin(self) -> None:
        """Rows of other weights are next."""
        self.state = SharesState(*np.zeros((2, self._n_v)))

    def taken_off(self, N: Array, synthetic: Array, residual: Array) -> tuple[Array, Array]:
        """N (n_v, ·) without what it shares with the residual (n_v,), and the noise (n_v, nuisances) that stays in it.

        synthetic (n_v, nuisances, SAMPLES): of that noise; rows are whitened, or divided by their deviations. Of a
        residual that noise does not make, as of an estimate from a few rows, nothing follows: there all of it stays.
        """
        now, noise = self.state, np.abs(residual) < LARGEST
        own = np.where(noise, residual, 0.0)
        now.residual, now.windows = now.residual + own**2, now.windows + noise
        out = N.copy()
        out[:, self._columns] -= shares(synthetic, now.residual, now.windows) * own[:, None]
        return out, synthetic[..., 0] * ~noise[:, None]


def shares(synthetic: Array, residual: Array, windows: float | Array) -> Array:
    """Shares (…, n_v, nuisances) of noise in the residuals of rows, from samples of it (…, n_v, nuisances, SAMPLES).

    Row by row, as noise is most of it in some and little where an axis sticks. No share is bounded by one: the means of
    few squares would come out low. residual: sum of their squares (n_v,) over so many windows. Larger ones than noise
    makes are those of a poor fit; smaller ones mean that noise is overstated.
    """
    variance = np.divide(residual, windows, out=np.ones_like(residual), where=(residual > 0.0) & (residual < windows))
    return np.asarray(np.mean(synthetic**2, axis=-1) / variance[:, None])
