"""Momentum balance of the joints in weak form: the residual that each motor's torque leaves, over short windows.

The rows that hold τ_i, (36) (on a rigid joint with (35) added), times φ(z) = (1 - z²)⁴ and integrated by parts, so that
only positions and speeds appear: -∫ (φ̇ P + φ G) dt π = ∫ φ n τ dt.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.energy_balance import BalanceRows
from sms_online.pipeline.weak_form import test_function
from sms_online.state import Stage, State
from sms_online.stream import Array

# Exponent of the test function: with its first three derivatives zero at the ends, sums over samples are integrals.
EXPONENT = 4
# A quarter of the data is enough for an rms, so short windows leave three times their width out; but windows follow
# each other at least this often, s, and overlap by half at most.
LARGEST_HOP = 0.4


class SquaredResidual(State):
    """Sums that give the rms of Y β - b for any β: the Gram matrix of [Y b], (n + 1, n + 1), and the measured signal's.

    A Gram matrix gives a residual down to 1e-8 of b, which is enough for a share of the signal. It is replaced, never
    written, so whoever keeps one has the sum of then.
    """

    gram: Array
    signal: float = 0.0

    def add(self, Y: Array, b: Array, signal: float) -> None:
        """Add rows Y (M, n), b (M,), and the measured torque or force behind b, before what is known was subtracted."""
        stacked = np.concatenate((Y, b[:, None]), axis=1)
        self.gram = self.gram + stacked.T @ stacked
        self.signal += float(signal) ** 2

    def relative(self, beta: Array) -> float | None:
        """rms of the residual over rms of the measured signal; None where there is none."""
        if self.signal == 0.0:
            return None
        w = np.append(beta, -1.0)
        return float(np.sqrt(max(0.0, w @ self.gram @ w) / self.signal))


class JointState(State):
    """What the joints' balances keep.

    samples (B, ·): x, v and signals that windows to come ask for; skip: samples to pass over before the next one.

    residuals: of each joint.
    """

    samples: Array
    residuals: list[SquaredResidual]
    skip: int = 0


class JointBalance(Stage):
    """Turns consecutive samples into weak-form rows of every joint, in N m s (N s)."""

    def __init__(self, model: Model, base: BaseParameters, sample_rate: float) -> None:
        self.model = model
        self.base = base
        seconds = model.system.windows.relative
        self.width = 2 * max(1, round(0.5 * seconds * sample_rate))
        self.hop = max(self.width // 2, min(4 * self.width, round(LARGEST_HOP * sample_rate)))
        phi, phi_dot, _ = test_function(self.width, self.width / sample_rate, EXPONENT)
        self._phi, self._phi_dot = phi / sample_rate, phi_dot / sample_rate
        layout, n = model.layout, base.n
        columns = layout.n_x + layout.n_v + model.n_signals
        residuals = [SquaredResidual(np.zeros((n + 1, n + 1))) for _ in layout.q]
        self.state = JointState(np.empty((0, columns)), residuals)

    def begin_segment(self) -> None:
        """Forget the samples before a gap."""
        self.state.samples, self.state.skip = self.state.samples[:0], 0

    def push(self, index: NDArray[np.int64], x: Array, v: Array, signals: Array) -> list[tuple[BalanceRows, Array]]:
        """For each window that the samples complete, its rows, one a joint, and the torques (joints,) behind them.

        signals (B, n_signals): see `Model.inputs`.
        """
        samples = np.concatenate((self.state.samples, np.concatenate((x, v, signals), axis=1)))
        grid_end = int(index[-1])
        rows = []
        start = self.state.skip
        while start + self.width + 1 <= samples.shape[0]:
            end = grid_end - (samples.shape[0] - 1) + start + self.width
            rows.append(self._window(samples[start : start + self.width + 1], end))
            start += self.hop
        dropped = min(start, samples.shape[0])
        self.state.samples, self.state.skip = samples[dropped:], start - dropped
        return rows

    def _window(self, samples: Array, end: int) -> tuple[BalanceRows, Array]:
        layout = self.model.layout
        x, v, signals = np.split(samples, [layout.n_x, layout.n_x + layout.n_v], axis=1)
        P, G = self.model.momentum_columns(x, v, layout.theta_m, self.model.inputs(signals))
        columns = -(np.tensordot(self._phi_dot, P, 1) + np.tensordot(self._phi, G, 1))
        measured = self._phi @ signals[:, : len(layout.q)]
        b = measured - self.base.known_part(columns)
        return BalanceRows(self.base.columns(columns), b, np.full(len(layout.q), end)), measured
