"""Equations of motion between nodes of time, by collocation: how far a motion misses them, and its linearisation.

Lobatto's three-point collocation (IIIA, order four; Hermite-Simpson), with the midpoint eliminated:

    s_{k+1} - s_k = h/6 (f_k + 4 f_m + f_{k+1}),    s_m = (s_k + s_{k+1})/2 + h/8 (f_k - f_{k+1}).

It is A-stable, so the stiff modes of joints cost nothing. The state is s = [x, p̃]: positions, and the momenta less the
impulse of the measured torques, which makes p̃ smooth and lets torques be integrated at their own rate.
Source: Hairer, Wanner, Solving Ordinary Differential Equations II (1996), IV.5; Betts, Practical Methods for Optimal
Control (2010), ch. 4, for the compressed form.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_online.linearised import LinearSystem, Motion
from sms_online.model.dynamics import Dynamics
from sms_online.stream import Array

# States evaluated in one call: enough to hide its overhead, little memory.
STATES_PER_CALL = 512


@dataclass(frozen=True)
class Transitions:
    """The linearised step: s_{k+1} = Φ s_k + Γ w_k + B δβ + d, with K steps, m = 2 n_v states, unit noise w.

    Phi (K, m, m), Gamma (K, m, noises), B (K, m, n), d (K, m).
    """

    Phi: Array
    Gamma: Array
    B: Array
    d: Array


def momenta_and_forces(dynamics: Dynamics, x: Array, v: Array) -> tuple[Array, Array]:
    """P π and G π (B, n_v): momenta, and their rates but for the motors'."""
    pieces = [slice(k, k + STATES_PER_CALL) for k in range(0, len(x), STATES_PER_CALL)]
    parts = [dynamics.momentum_and_force(x[piece], v[piece]) for piece in pieces]
    return np.concatenate([p for p, _ in parts]), np.concatenate([g for _, g in parts])


def defects(dynamics: Dynamics, motion: Motion, impulse: Array, impulse_m: Array) -> Array:
    """What the K steps of a motion lack, (K, 2 n_v): h/6 (f_k + 4 f_m + f_{k+1}) - (s_{k+1} - s_k).

    Of Euler parameters it is the small inertial rotation that they lack.
    impulse (K + 1, n_v), impulse_m (K, n_v): of the motors, at the nodes and at the midpoints.
    """
    layout = dynamics.model.layout
    h, x, v = motion.step, motion.x, motion.v
    rate = layout.position_rate(x, v)
    p, g = momenta_and_forces(dynamics, x, v)
    p = p - impulse
    x_m = 0.5 * (x[1:] + x[:-1]) + h / 8.0 * (rate[:-1] - rate[1:])
    p_m = 0.5 * (p[1:] + p[:-1]) + h / 8.0 * (g[:-1] - g[1:]) + impulse_m
    v_m: Array = np.asarray(np.linalg.solve(dynamics.mass_matrix(x_m), p_m[..., None])[..., 0], dtype=np.float64)
    _, g_m = momenta_and_forces(dynamics, x_m, v_m)
    of_x = h / 6.0 * (rate[:-1] + 4.0 * layout.position_rate(x_m, v_m) + rate[1:]) - np.diff(x, axis=0)
    of_p = h / 6.0 * (g[:-1] + 4.0 * g_m + g[1:]) - np.diff(p, axis=0)
    return np.concatenate((layout.speeds(x[1:], of_x), of_p), axis=1)


def transitions(linear: LinearSystem, step: float, drive: Array, joints: int, defect: Array) -> Transitions:
    """Linearised steps between the B = K + 1 nodes of a linear system.

    drive (2 n_v, noises): what unit noise adds to the state in a step. joints: number of the columns of E that torques
    have. defect (K, 2 n_v): of the motion that the system is linearised about.
    """
    A, E, h = linear.A, linear.E[..., joints:], step
    A_m, E_m, eye = 0.5 * (A[1:] + A[:-1]), 0.5 * (E[1:] + E[:-1]), np.eye(A.shape[1])
    ahead = eye - h / 6.0 * (A[1:] + 4.0 * A_m @ (0.5 * eye - h / 8.0 * A[1:]))
    behind = eye + h / 6.0 * (A[:-1] + 4.0 * A_m @ (0.5 * eye + h / 8.0 * A[:-1]))
    driven = h / 6.0 * (E[:-1] + 4.0 * (E_m + A_m @ (h / 8.0 * (E[:-1] - E[1:]))) + E[1:])
    noise = np.broadcast_to(drive, (len(defect), *drive.shape))
    solved = np.linalg.solve(ahead, np.concatenate((behind, noise, driven, defect[..., None]), axis=2))
    Phi, Gamma, B, d = np.split(solved, np.cumsum((len(eye), drive.shape[1], E.shape[2])), axis=2)
    return Transitions(Phi, Gamma, B, d[..., 0])
