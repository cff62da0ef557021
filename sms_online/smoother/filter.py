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

    root (m, m), mean (m, 1 + n): of the first state, which has the mean `mean` [1, δβ] and the covariance rootᵀ root;
    behind the last step, of the last state with all samples so far.
    """

    def __init__(self, root: Array, mean: Array) -> None:
        self.root, self.mean = root, mean
        self._upper, self._eye = np.triu(np.ones_like(root)), np.eye(len(root))
        self._past: list[tuple[Array, ...]] = []

    def push(self, e: Array, C: Array, D: Array, steps: Transitions) -> Array:
        """Samples at B nodes, each with the step behind it, the last one without; whitened innovations (rows, 1 + n).

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
            goes_on = k < len(steps.Phi)
            Phi = steps.Phi[k] if goes_on else self._eye
            before[n_y : n_y + m, :n_y] = self.root @ C[k].T
            before[n_y : n_y + m, n_y:] = self.root @ Phi.T
            before[n_y + m :, n_y:] = steps.Gamma[k].T if goes_on else 0.0
            after = raw_triangle(before)  # [[R_e^½, gainᵀ], [·, root of the next covariance]]
            root, gain = after[:n_y, :n_y], after[:n_y, n_y:]
            innovation = -C[k] @ self.mean
            innovation[:, 0] += e[k]
            innovation[:, 1:] -= D[k]
            white = dtrtrs(root, innovation, trans=1)[0]
            rows.append(white[sampled[k]])
            self._past.append((self.root, self.mean, C[k], root, white, Phi, gain))
            self.mean = Phi @ self.mean + gain.T @ white
            if goes_on:
                self.mean[:, 0] += steps.d[k]
                self.mean[:, 1:] += steps.B[k]
            self.root = after[n_y : n_y + m, n_y:] * self._upper
        return np.concatenate(rows)

    def smooth(self, delta: Array) -> Array:
        """Smoothed deviations (K + 1, m) of all nodes for δβ (n,)."""
        full = np.concatenate(([1.0], delta))
        out = np.empty((len(self._past), len(self.root)))
        adjoint = np.zeros(len(self.root))
        for k in range(len(self._past) - 1, -1, -1):
            L, M, C, root, white, Phi, gain = self._past[k]
            innovation = white @ full - gain @ adjoint
            adjoint = Phi.T @ adjoint + C.T @ dtrtrs(root, innovation)[0]
            out[k] = M @ full + L.T @ (L @ adjoint)
        return out
