"""Joint references as Fourier series, of which (46) is one with a single term."""

from __future__ import annotations

import numpy as np

from sms_online.description.schema import Trajectory
from sms_online.stream import Array


class FourierReference:
    """q_d,i(t) = Σ sine sin(ω t) + cosine (cos(ω t) - 1): starts at 0, and unless Σ sine ω = 0 with a step in rate."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.joints = len(trajectory.joints)
        terms = [(joint, harmonic) for joint, series in enumerate(trajectory.joints) for harmonic in series]
        self._frequency = np.array([harmonic.frequency for _, harmonic in terms])
        # (terms, joints): amplitude of a term on its joint, rad (m on a prismatic joint)
        self._sine = np.zeros((len(terms), self.joints))
        self._cosine = np.zeros((len(terms), self.joints))
        for k, (joint, harmonic) in enumerate(terms):
            self._sine[k, joint] = harmonic.sine
            self._cosine[k, joint] = harmonic.cosine

    def __call__(self, t: Array) -> tuple[Array, Array]:
        """q_d and q̇_d (B, joints) at instants t (B,), s: rad and rad/s (m and m/s)."""
        phase = t[:, None] * self._frequency
        sin, cos = np.sin(phase), np.cos(phase)
        q_d = sin @ self._sine + (cos - 1.0) @ self._cosine
        q_d_dot = (cos * self._frequency) @ self._sine - (sin * self._frequency) @ self._cosine
        return q_d, q_d_dot
