"""Momentum balance of the joints in weak form: the residual that each motor's torque leaves, over short windows.

The rows that hold τ_i, (36) (on a rigid joint with (35) added), times φ(z) = (1 - z²)⁴ and integrated by parts, so that
only positions and speeds appear: -∫ (φ̇ P + φ G) dt π = ∫ φ n τ dt.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import numpy as np

from sms_online.calibration.channels import Motion
from sms_online.calibration.joints import JointCalibration
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.weak_form import test_function
from sms_online.state import Stage, State
from sms_online.stream import Array

# Exponent of the test function: with its first three derivatives zero at the ends, sums over samples are integrals.
EXPONENT = 4
# A quarter of the data is enough for an rms, so short windows leave three times their width out; but windows follow
# each other at least this often, s, and overlap by half at most.
LARGEST_HOP = 0.4


class SquaredResidual(State):
    """Sums that give the rms of a joint's residual for any β and nuisances, and that of the measured signal.

    gram: of [Y D T b]; D, T: what deflections and torques are read too much for nuisances with numbers `deflections`
    and `torques`. spring: number of the joint's stiffness, -1 where it has none. A Gram matrix gives a residual down to
    1e-8 of b, which is enough for a share of the signal. It is replaced, never written, so whoever keeps one has the
    sum of then.
    """

    gram: Array
    deflections: list[int] = msgspec.field(default_factory=list)
    torques: list[int] = msgspec.field(default_factory=list)
    spring: int = -1
    signal: float = 0.0

    def since(self, then: SquaredResidual | None) -> SquaredResidual:
        """The sums of what came after another moment of the session, of all where there is none."""
        gram, signal = (0.0, 0.0) if then is None else (then.gram, then.signal)
        return SquaredResidual(self.gram - gram, self.deflections, self.torques, self.spring, self.signal - signal)

    def add(self, row: Array, signal: float) -> None:
        """Add a row [Y D T b], and the measured torque or force behind b, before what is known was subtracted."""
        self.gram = self.gram + np.outer(row, row)
        self.signal += float(signal) ** 2

    def relative(self, beta: Array, nuisances: Array | None = None) -> float | None:
        """rms of the residual over rms of the measured signal; None where there is none.

        nuisances (m,): all of the session's, zeros unless given.
        """
        if self.signal == 0.0:
            return None
        w = self.unknowns(beta, nuisances)
        return float(np.sqrt(max(0.0, float(w @ self.gram @ w)) / self.signal))

    def unknowns(self, beta: Array, nuisances: Array | None = None) -> Array:
        """What multiplies the columns of `gram`: β (n,), nuisances (m,) of the session, zeros unless given, and -1."""
        turned, gained = np.zeros(len(self.deflections)), np.zeros(len(self.torques))
        if nuisances is not None and nuisances.size:
            stiffness = beta[self.spring] if self.spring >= 0 else 0.0
            turned, gained = -stiffness * nuisances[self.deflections], nuisances[self.torques]
        return np.concatenate((beta, turned, gained, [-1.0]))


class JointState(State):
    """What the joints' balances keep.

    samples (B, ·): x, v and signals that windows to come ask for; skip: samples to pass over before the next one.

    residuals: of each joint.
    """

    samples: Array
    residuals: list[SquaredResidual]
    skip: int = 0


class JointBalance(Stage):
    """Turns consecutive samples into weak-form rows of every joint, in N m s (N s).

    sensing: what has nuisances, where they are estimated. gapless: windows that overlap by half.
    """

    def __init__(
        self,
        model: Model,
        base: BaseParameters,
        sample_rate: float,
        sensing: Sensing | None = None,
        gapless: bool = False,
    ) -> None:
        self.model = model.of_parameters(base.needed)
        self.base = base
        self._sensing, self._sample_rate = sensing, sample_rate
        self._calibration = None if sensing is None else JointCalibration(sensing)
        seconds = model.system.windows.relative
        self.width = 2 * max(1, round(0.5 * seconds * sample_rate))
        self.hop = self.width // 2
        if not gapless:
            self.hop = max(self.hop, min(4 * self.width, round(LARGEST_HOP * sample_rate)))
        phi, phi_dot, _ = test_function(self.width, self.width / sample_rate, EXPONENT)
        self._phi, self._phi_dot = phi / sample_rate, phi_dot / sample_rate
        layout, n = model.layout, base.n
        columns = layout.n_x + layout.n_v + model.n_signals
        self._speeds = [layout.n_x + theta_m for theta_m in layout.theta_m]
        numbers: tuple[list[int], list[int]] = ([], [])
        if self._calibration is not None:
            numbers = self._calibration.positions, self._calibration.torques
        width = n + sum(map(len, numbers)) + 1
        names = [p.name for p in base.parameters]
        springs = [f"joint_{i}.stiffness" for i in range(1, len(layout.q) + 1)]
        residuals = [
            SquaredResidual(np.zeros((width, width)), *numbers, names.index(each) if each in names else -1)
            for each in springs
        ]
        self.state = JointState(np.empty((0, columns)), residuals)

    def begin_segment(self) -> None:
        """Forget the samples before a gap."""
        self.state.samples, self.state.skip = self.state.samples[:0], 0

    def push(self, x: Array, v: Array, signals: Array) -> None:
        """Add the rows of each window that the samples complete to the joints' residuals.

        signals (B, n_signals): see `Model.inputs`.
        """
        for _, rows, measured, _ in self.windows(x, v, signals):
            for residual, row, signal in zip(self.state.residuals, rows, measured, strict=True):
                if np.isfinite(row).all():
                    residual.add(row, signal)

    def windows(self, x: Array, v: Array, signals: Array) -> Iterator[tuple[int, Array, Array, Array]]:
        """Each window that further samples complete: its first sample, rows, measured torques or forces, and speeds.

        The sample is counted from the first of these, negative where it came before. rows (joints, ·): [Y D T b], see
        `SquaredResidual`. measured (joints,): N m s (N s). speeds (joints,): largest of each motor, rad/s (m/s).
        """
        held = self.state.samples.shape[0]
        samples = np.concatenate((self.state.samples, np.concatenate((x, v, signals), axis=1)))
        start = self.state.skip
        while start + self.width + 1 <= samples.shape[0]:
            window = samples[start : start + self.width + 1]
            yield start - held, *self._window(window), np.abs(window[:, self._speeds]).max(axis=0)
            start += self.hop
        dropped = min(start, samples.shape[0])
        self.state.samples, self.state.skip = samples[dropped:], start - dropped

    @property
    def weight(self) -> float:
        """∫ φ dt, s."""
        return float(self._phi.sum())

    def _window(self, samples: Array) -> tuple[Array, Array]:
        layout = self.model.layout
        x, v, signals = np.split(samples, [layout.n_x, layout.n_x + layout.n_v], axis=1)
        P, G = self.model.momentum_columns(x, v, layout.theta_m, self.model.inputs(signals))
        columns = -(np.tensordot(self._phi_dot, P, 1) + np.tensordot(self._phi, G, 1))
        measured = self._phi @ signals[:, : len(layout.q)]
        b = measured - self.base.known_part(columns)
        return np.concatenate((self.base.columns(columns), *self._calibrated(x, signals), b[:, None]), axis=1), measured

    def _calibrated(self, x: Array, signals: Array) -> tuple[Array, ...]:
        """D and T (joints, ·) of a window's samples, none where no nuisances are estimated."""
        if self._sensing is None or self._calibration is None:
            return ()
        readings = self._sensing.readings(x)
        rates = np.gradient(readings, axis=0) * self._sample_rate
        _, T_0 = self.model.layout.base_pose(x)
        motion = Motion(readings, rates, signals[:, : len(self.model.layout.q)], T_0)
        each = self._calibration.deflections(motion), self._calibration.torque(motion)
        return tuple(np.tensordot(self._phi, part, 1) for part in each)
