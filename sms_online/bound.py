"""Cramér–Rao bound of π: the least standard deviation that an unbiased estimator can reach with given sensors.

All positions and the joint torques are measured with white noise. The measured torque is the input of the equations of
motion, so its noise drives the state; controller and initial state are unknown. Linearised about the true motion, with
s = [δx, δv] (attitude as a small inertial rotation),

    s_{k+1} = Φ_k s_k + Γ_k δ(n τ)_k + B_k δβ,    δy_k = C_k s_k + noise,

the innovations of the Kalman filter of s are white and depend linearly on β, which gives Fisher's information as
Σ Sᵀ R_e⁻¹ S with S their sensitivity. Source: Kailath, Sayed, Hassibi, Linear Estimation (2000), ch. 9 for the
innovations and ch. 12 for the square-root array form used here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Dynamics, Model
from sms_online.model.so3 import skew
from sms_online.stream import Array

# Step of the central differences, rad, m (and s along the motion): truncation and rounding both near 1e-10 relative.
DIFFERENCE = 1e-5
# States evaluated in one call of the model: enough to hide the cost of a call, little memory.
STATES_PER_CALL = 2000
# Initial standard deviations, rad or m and rad/s or m/s, that leave the initial state free: ten thousand times what
# sensors of the coarsest grade resolve.
FREE_POSITION = 10.0
FREE_SPEED = 100.0
# A step is halved until the scaled norm of A h is below SMALL_STEP: a Taylor series to this order is then exact to
# rounding.
SMALL_STEP = 0.25
TAYLOR_ORDER = 10
# Singular values of the information's root, with columns of unit length, below this share of the largest are zero: the
# columns are differences good to 1e-10, while a combination that the motion does determine stays above 1e-6.
RANK_TOLERANCE = 1e-8
# Share of a parameter in an undetermined direction above which it is itself undetermined.
UNDETERMINED_SHARE = 1e-6


@dataclass(frozen=True)
class LinearSystem:
    """The linearised system at B instants, m = 2 n_v states.

    A (B, m, m): of ṡ = A s. E (B, m, joints + n): columns by which joint torques n τ and parameters β drive ṡ.
    C (B, n_x, m): readings of base and joint positions, then of markers, by s.
    """

    A: Array
    E: Array
    C: Array


def cramer_rao_bound(
    dynamics: Dynamics,
    base: BaseParameters,
    t: Array,
    x: Array,
    v: Array,
    joint_torque: Array,
    sigma_x: Array,
    sigma_tau: Array,
) -> Array:
    """Least standard deviation (n,) of every base parameter, in its unit; inf where the motion does not determine it.

    t (B,) s, uniform; x (B, n_x), v (B, n_v), n τ (B, joints) on the true motion under `dynamics`; the last instant
    only ends the last step. sigma_x (n_x,): noise of the positions, markers in the place of elastic coordinates;
    sigma_tau (joints,): of n τ, N m (N). Both 1σ, white per sample at the system's sample rate, positive.

    t may be coarser than that rate: of white noise only the density σ² T_s matters where the step is short against what
    an estimator averages over, so that fewer samples with less noise say the same. The step has to follow the motion,
    though. Planar example, grade B, 20 s: 1 and 2 ms agree to 0.5 %, but for joint_2.damping to 4 %; at 10 ms that one,
    which lives in the jolt at the start, comes out 28 % too low.
    Raises ValueError where t is not uniform.
    """
    step = (t[-1] - t[0]) / (t.size - 1)
    if not np.allclose(np.diff(t), step, rtol=1e-6, atol=0.0):
        raise ValueError("the bound needs instants at a uniform step")
    model = dynamics.model
    joints = len(model.layout.q)
    shrink = np.sqrt(step * model.system.sample_rate)
    sensors = sigma_x / shrink
    drive = sigma_tau / shrink
    information = Information(model.layout.n_v, base.n)
    B = max(1, STATES_PER_CALL // model.layout.n_v)
    for start in range(0, t.size - 1, B):
        rows = slice(start, start + B + 1)
        linear = linearise(dynamics, base, x[rows], v[rows], joint_torque[rows])
        Phi, D = discretise(_middle(linear.A), _middle(linear.E), step)
        information.add(linear.C[:-1] / sensors[:, None], Phi, D[..., :joints] * drive, D[..., joints:])
    return information.standard_deviations()


def _middle(samples: Array) -> Array:
    return np.asarray(0.5 * (samples[1:] + samples[:-1]))


def linearise(dynamics: Dynamics, base: BaseParameters, x: Array, v: Array, joint_torque: Array) -> LinearSystem:
    """The equations of motion (40) and the readings, linearised at x (B, n_x), v (B, n_v), n τ (B, joints)."""
    model, layout = dynamics.model, dynamics.model.layout
    (B, n_v), joints = v.shape, joint_torque.shape[1]
    H, bias = dynamics.mass_and_bias(x, v)
    Q = model.generalized_force(joint_torque)
    a = np.asarray(np.linalg.solve(H, (Q - bias)[..., None])[..., 0], dtype=np.float64)
    # Every instant n_v times, moved along one coordinate or rate each.
    x_n, v_n, a_n = (np.repeat(values, n_v, axis=0) for values in (x, v, a))
    dv = DIFFERENCE * np.tile(np.eye(n_v), (B, 1))
    dx = layout.position_rate(x_n, dv)

    def difference(plus: Array, minus: Array) -> Array:
        """Derivatives (B, ·, n_v), a column for each coordinate moved."""
        return np.asarray(((plus - minus) / (2.0 * DIFFERENCE)).reshape(B, n_v, -1).transpose(0, 2, 1))

    def inverse_dynamics(x: Array, v: Array) -> Array:
        """H v̇ + C at the unmoved v̇."""
        H, bias = dynamics.mass_and_bias(x, v)
        return np.asarray((H @ a_n[..., None])[..., 0] + bias)

    forces = np.concatenate(
        (
            difference(inverse_dynamics(x_n + dx, v_n), inverse_dynamics(x_n - dx, v_n)),
            difference(inverse_dynamics(x_n, v_n + dv), inverse_dynamics(x_n, v_n - dv)),
            np.broadcast_to(-model.generalized_force(np.eye(joints)).T, (B, n_v, joints)),
            base.columns(inverse_dynamics_columns(model, x, v, a)),
        ),
        axis=2,
    )
    accelerations = -np.linalg.solve(H, forces)
    A = np.zeros((B, 2 * n_v, 2 * n_v))
    A[:, :n_v, n_v:] = np.eye(n_v)
    A[:, n_v:] = accelerations[..., : 2 * n_v]
    if layout.free and not layout.planar:
        # A small inertial rotation φ of the attitude obeys φ̇ = δω + ω × φ.
        A[:, 3:6, 3:6] = skew(v[:, 3:6])
    E = np.zeros((B, 2 * n_v, joints + base.n))
    E[:, n_v:] = accelerations[..., 2 * n_v :]
    C = np.zeros((B, layout.n_x, 2 * n_v))
    C[..., :n_v] = difference(_readings(model, x_n + dx), _readings(model, x_n - dx))
    return LinearSystem(A, E, C)


def inverse_dynamics_columns(model: Model, x: Array, v: Array, a: Array) -> Array:
    """Columns (B, n_v, n_pi) of H v̇ + C: d/dt P - G, (33)–(37), with P differenced along the motion."""
    dx, dv = DIFFERENCE * model.position_rate(x, v), DIFFERENCE * a
    P_plus, _ = model.momentum_columns(x + dx, v + dv)
    P_minus, _ = model.momentum_columns(x - dx, v - dv)
    _, G = model.momentum_columns(x, v)
    return np.asarray((P_plus - P_minus) / (2.0 * DIFFERENCE) - G)


def _readings(model: Model, x: Array) -> Array:
    """What the position sensors read (B, n_x): x with every link's markers in the place of its elastic coordinates."""
    offset = model.layout.n_base_positions - model.layout.n_base_speeds
    y = x.copy()
    for i, (link, q_f) in enumerate(zip(model.chain.flexible, model.layout.q_f, strict=True)):
        if link is not None:
            y[:, q_f.start + offset : q_f.stop + offset] = link.markers(model.chain.elastic(x, i))
    return y


def discretise(A: Array, E: Array, step: float) -> tuple[Array, Array]:
    """Φ (B, m, m) and D (B, m, ·) of s_{k+1} = Φ s_k + D u_k for ṡ = A s + E u with A, E and u constant over a step, s.

    By scaling and squaring, exact to rounding however stiff A is (closed-loop poles reach -8500 1/s).
    """
    n_v = A.shape[1] // 2
    # Speeds in units that make both halves of A alike: fewer halvings.
    unit = np.ones(A.shape[1])
    unit[n_v:] = np.sqrt(max(1.0, float(np.abs(A[:, n_v:, :n_v]).max())))
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


def _triangle(rows: Array) -> Array:
    """Upper triangular R with Rᵀ R = rowsᵀ rows."""
    return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)


class Information:
    """Fisher's information of β by a Kalman filter of s in square-root array form."""

    def __init__(self, n_v: int, n: int) -> None:
        # P = Lᵀ L of s before the next sample; M = ∂ŝ/∂β.
        self._L = np.diag(np.repeat([FREE_POSITION, FREE_SPEED], n_v))
        self._M = np.zeros((2 * n_v, n))
        self._root = np.zeros((0, n))

    def add(self, C: Array, Phi: Array, Gamma: Array, B: Array) -> None:
        """K samples, each with the step after it: C (K, n_y, m), Φ (K, m, m), Γ (K, m, joints), B (K, m, n).

        Rows of C and columns of Γ are scaled to unit noise.
        """
        n_y = C.shape[1]
        eye = np.eye(n_y)
        rows = [self._root]
        for C_k, Phi_k, Gamma_k, B_k in zip(C, Phi, Gamma, B, strict=True):
            prior = np.block([[eye, np.zeros((n_y, C.shape[2]))], [self._L @ C_k.T, self._L]])
            posterior = _triangle(prior)  # [[R_e^½, R_e^-½ C P], [0, root of P after the sample]]
            S = scipy.linalg.solve_triangular(posterior[:n_y, :n_y], C_k @ self._M, trans="T")
            rows.append(S)
            self._M = Phi_k @ (self._M - posterior[:n_y, n_y:].T @ S) + B_k
            self._L = _triangle(np.concatenate((posterior[n_y:, n_y:] @ Phi_k.T, Gamma_k.T)))
        self._root = _triangle(np.concatenate(rows))

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
