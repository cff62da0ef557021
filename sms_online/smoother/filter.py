"""Kalman filter of the deviations from a motion, with their sensitivity to the parameters, and the smoother behind it.

Every filtered quantity is affine in δβ and carried as columns [1, δβ]: so one pass gives innovations
e - S δβ, white and of unit variance, which are rows of a least-squares problem in β; and one pass back gives the
smoothed states for the δβ that was chosen. Square-root array form forwards, Bryson and Frazier's adjoint form
backwards, which needs no inverse of a covariance. Source: Kailath, Sayed, Hassibi, Linear Estimation (2000), ch. 10
and 12.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dtrtrs

from sms_online.smoother.collocation import Transitions
from sms_online.stream import Array
from sms_online.trackers.factor import raw_triangle


class FixedIntervalSmoother:
    """Filter forwards through `push`, piece by piece, then `smooth` back.

    root (m, m): the first state has the covariance rootᵀ root. n: number of parameters.
    """

    def __init__(self, root: Array, n: int) -> None:
        self._L = root
        n_v = len(root) // 2
        self._M = np.zeros((2 * n_v, 1 + n))
        self._upper = np.triu(np.ones((2 * n_v, 2 * n_v)))
        self._past: list[tuple[Array, ...]] = []

    def push(self, e: Array, C: Array, D: Array, steps: Transitions) -> Array:
        """Samples at B nodes, each with the step behind it where there is one; whitened innovations (rows, 1 + n).

        e (B, n_y), C (B, n_y, m), D (B, n_y, n): differences, and readings by state and parameters, in units of the
        noise; a row of zeros in C is no sample. The innovation of [1, δβ] is row @ [1, δβ].
        """
        n_y, m = C.shape[1:]
        noises = steps.Gamma.shape[2]
        before = np.zeros((n_y + m + noises, n_y + m))
        before[:n_y, :n_y] = np.eye(n_y)
        sampled = np.asarray(C.any(axis=2))
        rows = []
        for k in range(len(e)):
            Phi = steps.Phi[k] if k < len(steps.Phi) else None
            before[n_y : n_y + m, :n_y] = self._L @ C[k].T
            before[n_y : n_y + m, n_y:] = 0.0 if Phi is None else self._L @ Phi.T
            before[n_y + m :, n_y:] = 0.0 if Phi is None else steps.Gamma[k].T
            after = raw_triangle(before)  # [[R_e^½, gainᵀ], [·, root of the next covariance]]
            root, gain = after[:n_y, :n_y], after[:n_y, n_y:]
            innovation = -C[k] @ self._M
            innovation[:, 0] += e[k]
            innovation[:, 1:] -= D[k]
            white = dtrtrs(root, innovation, trans=1)[0]
            rows.append(white[sampled[k]])
            self._past.append((self._L, self._M, C[k], root, white) if Phi is None else
                              (self._L, self._M, C[k], root, white, Phi, gain))  # fmt: skip
            if Phi is not None:
                self._M = Phi @ self._M + gain.T @ white
                self._M[:, 0] += steps.d[k]
                self._M[:, 1:] += steps.B[k]
                self._L = after[n_y : n_y + m, n_y:] * self._upper
        return np.concatenate(rows)

    def smooth(self, delta: Array) -> Array:
        """Smoothed deviations (K + 1, m) of all nodes for δβ (n,)."""
        full = np.concatenate(([1.0], delta))
        out = np.empty((len(self._past), len(self._L)))
        adjoint = np.zeros(len(self._L))
        for k in range(len(self._past) - 1, -1, -1):
            L, M, C, root, white, *step = self._past[k]
            innovation = white @ full
            if step:
                Phi, gain = step
                innovation = innovation - gain @ adjoint
                adjoint = Phi.T @ adjoint
            adjoint = adjoint + C.T @ dtrtrs(root, innovation)[0]
            out[k] = M @ full + L.T @ (L @ adjoint)
        return out
