"""Output-error fit: simulate with the measured torques, compare with the measured positions, let SciPy minimise.

The session is cut into segments, the initial state of each an unknown too (multiple shooting: Bock, in Deuflhard and
Hairer, Numerical Treatment of Inverse Problems, 1983). One simulation of 20 s would not do: noise of the measured
torque is integrated twice and moves the joints by a hundredth of a radian until then.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares

from sms_online.cramer_rao import discretise
from sms_online.linearised import linearise
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.model.readings import Readings
from sms_online.stream import Array

# Length of a segment, s: noise of the torque moves a joint by less than its encoder's noise in it.
SEGMENT = 0.25
# Runge-Kutta steps a sample: they follow a pole of -13900 1/s, the planar example's fastest is at -8400 1/s.
STEPS = 5
# Standard deviation of ln β about where it starts, a prior: left alone, the weakest parameter makes that pole too fast
# to follow. To what the data determine it is nothing.
PRIOR = 0.1
# Residuals are means of so many samples, which keeps all information of a motion below 50 Hz.
AVERAGED = 10
# Samples from one linearisation of the Jacobian to the next; the links' modes at 100 and 120 Hz ask for it.
LINEARISED = 2
# Relative change of cost and unknowns that ends the search: a tenth of a standard deviation changes the cost so much.
TOLERANCE = 1e-6


@dataclass
class OutputError:
    """Residuals and Jacobian of all segments of a planar session with linear links, where readings are coordinates.

    x (B, n_x), torque (B, joints): measured positions and n τ, at the system's rate. sigma (n_x,): noise of x. Unknowns
    are ln β (n,), then positions and momenta at the start of each segment.
    """

    model: Model
    base: BaseParameters
    x: Array
    torque: Array
    sigma: Array

    def __post_init__(self) -> None:
        self._last: tuple[Array, Array, Array] | None = None

    @cached_property
    def samples(self) -> int:
        """Samples of a segment, without its end."""
        return round(SEGMENT * self.model.system.sample_rate)

    @cached_property
    def segments(self) -> int:
        """Number of whole segments."""
        return (len(self.x) - 1) // self.samples

    def split(self, unknowns: Array) -> tuple[Array, Array, Array]:
        """β (n,), and x, p (segments, n_v) at the segments' starts."""
        n, n_v = self.base.n, self.model.layout.n_v
        starts = unknowns[n:].reshape(self.segments, 2 * n_v)
        return np.exp(unknowns[:n]), starts[:, :n_v], starts[:, n_v:]

    def first_guess(self, beta: Array, x: Array, v: Array) -> Array:
        """Unknowns for β (n,) and states x, v (segments, n_v)."""
        H = self.model.dynamics(self.base.physical_values(beta)).mass_matrix(x)
        p = (H @ v[..., None])[..., 0]
        return np.concatenate((np.log(beta), np.concatenate((x, p), axis=1).ravel()))

    def simulated(self, unknowns: Array) -> tuple[Array, Array]:
        """x, v (segments, samples, n_v) at the samples; SciPy asks for residual and Jacobian of the same unknowns."""
        if self._last is None or not np.array_equal(self._last[0], unknowns):
            self._last = (unknowns.copy(), *self._simulate(unknowns))
        return self._last[1:]

    def _simulate(self, unknowns: Array) -> tuple[Array, Array]:
        """By Runge-Kutta of order four, the torque linear between samples."""
        beta, x, p = self.split(unknowns)
        dynamics = self.model.dynamics(self.base.physical_values(beta))
        v: Array = np.asarray(np.linalg.solve(dynamics.mass_matrix(x), p[..., None])[..., 0], dtype=np.float64)
        h = 1.0 / (self.model.system.sample_rate * STEPS)
        begin = self.samples * np.arange(self.segments)
        out = np.empty((2, self.segments, self.samples, x.shape[1]))

        def rate(x: Array, v: Array, k: int, part: float) -> tuple[Array, Array]:
            torque = (1.0 - part) * self.torque[begin + k] + part * self.torque[begin + k + 1]
            return v, dynamics.acceleration(x, v, self.model.generalized_force(torque))

        for k in range(self.samples):
            out[0, :, k], out[1, :, k] = x, v
            for s in range(STEPS):
                x1, v1 = rate(x, v, k, s / STEPS)
                x2, v2 = rate(x + 0.5 * h * x1, v + 0.5 * h * v1, k, (s + 0.5) / STEPS)
                x3, v3 = rate(x + 0.5 * h * x2, v + 0.5 * h * v2, k, (s + 0.5) / STEPS)
                x4, v4 = rate(x + h * x3, v + h * v3, k, (s + 1.0) / STEPS)
                x, v = x + h / 6.0 * (x1 + 2.0 * x2 + 2.0 * x3 + x4), v + h / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4)
        return out[0], out[1]

    def residual(self, unknowns: Array) -> Array:
        """Simulated less measured positions over the noise of their means."""
        x, _ = self.simulated(unknowns)
        error = x - self.x[: self.segments * self.samples].reshape(x.shape)
        means = error.reshape(self.segments, -1, AVERAGED, x.shape[2]).mean(axis=2)
        return np.asarray(means / (self.sigma / np.sqrt(AVERAGED))).ravel()

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives of the residual, from the balance linearised along the simulated motion."""
        beta, *_ = self.split(unknowns)
        x, v = (part[:, ::LINEARISED] for part in self.simulated(unknowns))
        (segments, K, n_v), n, joints = x.shape, self.base.n, self.torque.shape[1]
        dynamics = self.model.dynamics(self.base.physical_values(beta))
        step = LINEARISED / self.model.system.sample_rate
        averaged = AVERAGED // LINEARISED
        out = np.zeros((segments, K // averaged, n_v, n + segments * 2 * n_v))
        for i in range(segments):
            linear = linearise(dynamics, self.base, Readings(self.model, ()), x[i], v[i])
            Phi, driven = discretise(0.5 * (linear.A[1:] + linear.A[:-1]), 0.5 * (linear.E[1:] + linear.E[:-1]), step)
            S = np.zeros((K, 2 * n_v, n + 2 * n_v))
            S[0, :, n:] = np.eye(2 * n_v)
            for k in range(K - 1):
                S[k + 1] = Phi[k] @ S[k]
                S[k + 1, :, :n] += driven[k, :, joints:] * beta
            means = S[:, :n_v].reshape(-1, averaged, n_v, n + 2 * n_v).mean(axis=1)
            own = slice(n + i * 2 * n_v, n + (i + 1) * 2 * n_v)
            out[i, :, :, :n], out[i, :, :, own] = means[..., :n], means[..., n:]
        scale = (self.sigma / np.sqrt(AVERAGED))[:, None]
        return np.asarray(out / scale).reshape(-1, out.shape[3])

    def fit(self, guess: Array) -> Array:
        """β (n,) of least squares, from unknowns to begin with."""
        n, prior = self.base.n, np.eye(self.base.n, guess.size) / PRIOR

        def residual(unknowns: Array) -> Array:
            return np.concatenate((self.residual(unknowns), (unknowns - guess)[:n] / PRIOR))

        def jacobian(unknowns: Array) -> Array:
            return np.concatenate((self.jacobian(unknowns), prior))

        found = least_squares(residual, guess, jacobian, x_scale="jac", ftol=TOLERANCE, xtol=TOLERANCE, gtol=None)
        return self.split(found.x)[0]
