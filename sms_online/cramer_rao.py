"""Cramér–Rao bound of π: the least standard deviation that an unbiased estimator can reach with given sensors.

Sensors have white noise. Measured torques and wrenches are inputs of the equations of motion: their noise drives it;
controller and initial state are unknown. Linearised about the true motion (`linearised`) the system is, in discrete
time,

    s_{k+1} = Φ_k s_k + Γ_k δ(n τ)_k + B_k δβ,    δy_k = C_k s_k + D_k δβ + noise,

the innovations of the Kalman filter of s are white and depend linearly on β, which gives Fisher's information as
Σ Sᵀ R_e⁻¹ S with S their sensitivity. Source: Kailath, Sayed, Hassibi, Linear Estimation (2000), ch. 9 for the
innovations and ch. 12 for the square-root array form used here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sms_online.errors import InputError
from sms_online.linearised import Motion, linearise
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.dynamics import Dynamics
from sms_online.model.model import Model
from sms_online.model.readings import Readings
from sms_online.sensor_set import SensorSet, session_sensors
from sms_online.stream import Array, Indices
from sms_online.threads import one_blas_thread
from sms_online.trackers.factor import raw_triangle

if TYPE_CHECKING:
    from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.observer import Observer

# Step of a bound, s. Planar example, grade B, 20 s: all bounds within 2 % of those at 1 ms (the second stator's inertia
# within 10 %), at a tenth of the cost.
STEP = 0.01
# Derivatives by displacements and readings are evaluated that often and interpolated, s: they follow the joints. The
# mass matrix, which carries conserved momenta, is evaluated at every step. 0.16 s changes no bound by 2 %.
DERIVATIVES_INTERVAL = 0.08
# Instants evaluated in one call: enough to hide its overhead, little memory.
INSTANTS_PER_CALL = 512
# Initial standard deviations, rad or m, and of the momenta as of speeds in rad/s or m/s, that leave the initial state
# free: ten thousand times what sensors of the coarsest grade resolve.
FREE_POSITION = 10.0
FREE_SPEED = 100.0
# A step is halved until the scaled norm of A h is below SMALL_STEP: a Taylor series to this order is then exact to
# rounding.
SMALL_STEP = 0.25
TAYLOR_ORDER = 10
# Singular values of the information's root, with columns of unit length, below this share of the largest are zero: the
# derivatives are good to 1e-8, while a combination that the motion does determine stays above 1e-6.
RANK_TOLERANCE = 1e-8
# Share of a parameter in an undetermined direction above which it is itself undetermined.
UNDETERMINED_SHARE = 1e-6


class MotionRecord(Observer):
    """A session's motion at the step of a bound, segment by segment; some 250 n_v bytes a second at STEP."""

    def __init__(self, sample_rate: float) -> None:
        self._sample_rate = sample_rate
        self._every = max(1, round(STEP * sample_rate))
        self._segments: dict[int, list[Motion]] = {}

    def motion(self, index: Indices, segment: int, x: Array, v: Array, inputs: Array, states: Array) -> None:
        """See `Observer`."""
        kept = index % self._every == 0
        piece = Motion(index[kept] / self._sample_rate, x[kept], v[kept], inputs[kept])
        self._segments.setdefault(segment, []).append(piece)

    @property
    def motions(self) -> list[Motion]:
        """One motion a segment; those too short to hold a step are left out."""
        joined = [
            Motion(*(np.concatenate([getattr(piece, name) for piece in pieces]) for name in ("t", "x", "v", "inputs")))
            for pieces in self._segments.values()
        ]
        return [motion for motion in joined if motion.t.size > 1]


@one_blas_thread()
def session_bound(estimator: Estimator, record: MotionRecord) -> Array | None:
    """Bound (n,) of a finished session at its own estimate, with the noise that it has used of its sensors.

    None where there is none: no noise known or no noise at all, no motion, parameters not determined, or estimates that
    are no mechanism, with a mass matrix that is not positive definite; nor where an effect needs more than a motion
    holds.
    """
    if estimator.smoother is not None and estimator.by_smoother:
        # The smoother's rows hold the information of all samples, linearised at its own estimate.
        return None if estimator.smoother.prior is not None else estimator.estimate().std
    noise = None if estimator.momentum is None else estimator.momentum.sensor_noise
    estimate, motions = estimator.estimate(), record.motions
    if noise is None or noise.exact or not motions or not estimate.determined.all() or _followed(estimator.model):
        return None
    dynamics = estimator.model.dynamics(estimator.base.physical_values(estimate.pi))
    try:
        for motion in motions:
            np.linalg.cholesky(dynamics.mass_matrix(motion.x))
    except np.linalg.LinAlgError:
        return None
    return cramer_rao_bound(dynamics, estimator.base, motions, session_sensors(estimator.sensing, noise))


@one_blas_thread()
def cramer_rao_bound(dynamics: Dynamics, base: BaseParameters, motions: Sequence[Motion], sensors: SensorSet) -> Array:
    """Least standard deviation (n,) of every base parameter, in its unit; inf where the motion does not determine it.

    motions: true motions under `dynamics`, of which the initial state is unknown each; the last instant only ends the
    last step. The step need not be that of the sensors: of white noise only the density counts while the step is short
    against what an estimator averages over. It has to follow the motion, though, see STEP.
    Limitations: a sensor slower than the motion is taken for one of as much density that is not. Where x and v are
    estimates themselves, their noise counts as excitation: bounds of more than some percent come out low.
    Raises ValueError where a motion has no uniform step, InputError where a reading is unknown or where an effect needs
    torques or internal states, which a motion does not hold.
    """
    if followed := _followed(dynamics.model):
        raise InputError(dynamics.model.system.name, "effect", followed[0], "effects of positions and speeds alone")
    readings = Readings(dynamics.model, sensors.channels)
    n_v, inputs = dynamics.model.layout.n_v, dynamics.model.n_inputs
    information = Information(n_v, base.n)
    for motion in motions:
        step = motion.step
        if not np.allclose(np.diff(motion.t), step, rtol=1e-6, atol=0.0):
            raise ValueError("the bound needs instants at a uniform step")
        every = max(1, round(DERIVATIVES_INTERVAL / step))
        instants = every * max(1, INSTANTS_PER_CALL // every)
        noise, drive = np.sqrt(sensors.density / step)[:, None], np.sqrt(sensors.torque / step)
        for start in range(0, motion.t.size - 1, instants):
            rows = slice(start, start + instants + 1)
            measured = None if motion.inputs is None else motion.inputs[rows]
            linear = linearise(dynamics, base, readings, motion.x[rows], motion.v[rows], every, measured)
            if start == 0:
                information.begin(linear.H[0])
            Phi, driven = discretise(_middle(linear.A), _middle(linear.E), step)
            Gamma, B = driven[..., :inputs] * drive, driven[..., inputs:]
            information.add(linear.C[:-1] / noise, linear.D[:-1] / noise, Phi, Gamma, B)
    return information.standard_deviations()


def _followed(model: Model) -> list[str]:
    """Effects that need torques or internal states, but for measured wrenches, whose noise is an input's."""
    declared = model.effects if model.wrenches is None else model.effects[1:]
    return [effect.key for effect in declared if effect.needs_torque or effect.n_states]


def _middle(samples: Array) -> Array:
    return np.asarray(0.5 * (samples[1:] + samples[:-1]))


def discretise(A: Array, E: Array, step: float) -> tuple[Array, Array]:
    """Φ (B, m, m) and D (B, m, ·) of s_{k+1} = Φ s_k + D u_k for ṡ = A s + E u with A, E and u constant over a step, s.

    By scaling and squaring, exact to rounding however stiff A is (closed-loop poles reach -8500 1/s).
    """
    n_v = A.shape[1] // 2
    # Momenta in a unit that makes displacements and momenta drive each other alike: fewer halvings.
    unit = np.ones(A.shape[1])
    force, speed = (float(np.abs(part).max()) for part in (A[:, n_v:, :n_v], A[:, :n_v, n_v:]))
    if force > 0.0:
        unit[n_v:] = np.sqrt(force / speed)
    A, E = A * unit / unit[:, None], E / unit[:, None]
    norm = float(np.abs(A).sum(axis=1).max()) * step
    halvings = max(0, int(np.ceil(np.log2(norm / SMALL_STEP)))) if norm > 0.0 else 0
    short = step / 2.0**halvings
    eye = np.eye(A.shape[1])
    series = np.broadcast_to(eye, A.shape)  # of (exp(Z) - 1)/Z for Z = A h, by Horner's rule
    for k in range(TAYLOR_ORDER, 1, -1):
        series = eye + (A @ series) * (short / k)
    change = (A @ series) * short  # Φ - 1, which squaring keeps apart from the 1 for the sake of its digits
    D = (series @ E) * short
    for _ in range(halvings):
        D = 2.0 * D + change @ D
        change = 2.0 * change + change @ change
    return (eye + change) * unit[:, None] / unit, D * unit[:, None]


class Information:
    """Fisher's information of β by a Kalman filter of s in square-root array form."""

    def __init__(self, n_v: int, n: int) -> None:
        self._n_v, self._n = n_v, n
        self._root = np.zeros((0, n))

    def begin(self, H: Array) -> None:
        """A motion begins, its initial state free; H (n_v, n_v): mass matrix there."""
        # P = Lᵀ L of s before the next sample; M = ∂ŝ/∂β.
        self._L = np.diag(np.repeat([FREE_POSITION, FREE_SPEED], self._n_v))
        self._L[self._n_v :, self._n_v :] @= H
        self._M = np.zeros((2 * self._n_v, self._n))

    def add(self, C: Array, D: Array, Phi: Array, Gamma: Array, B: Array) -> None:
        """K samples, each with the step after it: C (K, n_y, m), D (K, n_y, n), Φ (K, m, m), Γ (K, m, joints),
        B (K, m, n).

        Rows of C and D and columns of Γ are scaled to unit noise.
        """
        n_y, m = C.shape[1:]
        upper = np.triu(np.ones((m, m)))
        prior = np.zeros((n_y + m, n_y + m))
        prior[:n_y, :n_y] = np.eye(n_y)
        rows = [self._root]
        for C_k, D_k, Phi_k, Gamma_k, B_k in zip(C, D, Phi, Gamma, B, strict=True):
            prior[n_y:, :n_y], prior[n_y:, n_y:] = self._L @ C_k.T, self._L
            posterior = raw_triangle(prior)  # [[R_e^½, R_e^-½ C P], [·, root of P after the sample]]
            S = np.linalg.solve(np.triu(posterior[:n_y, :n_y]).T, C_k @ self._M + D_k)
            rows.append(S)
            self._M = Phi_k @ (self._M - posterior[:n_y, n_y:].T @ S) + B_k
            L = posterior[n_y:, n_y:] * upper
            self._L = raw_triangle(np.concatenate((L @ Phi_k.T, Gamma_k.T)))[:m] * upper
        self._root = np.triu(raw_triangle(np.concatenate(rows))[: self._n])

    def standard_deviations(self) -> Array:
        """Root of the diagonal of the information's inverse (n,); inf where it is singular."""
        norms = np.linalg.norm(self._root, axis=0)
        out = np.full(norms.size, np.inf)
        seen = np.flatnonzero(norms)
        _, values, V = np.linalg.svd(self._root[:, seen] / norms[seen])
        singular = np.zeros(seen.size)  # fewer readings than parameters leave the rest at zero
        singular[: values.size] = values
        determined = singular > RANK_TOLERANCE * singular.max(initial=0.0)
        variance = ((V[determined] / singular[determined, None]) ** 2).sum(axis=0)
        lost = (np.abs(V[~determined]) > UNDETERMINED_SHARE).any(axis=0)
        out[seen] = np.where(lost, np.inf, np.sqrt(variance) / norms[seen])
        return out
