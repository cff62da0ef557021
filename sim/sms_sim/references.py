"""Joint references as Fourier series, of which (46) is one with a single term."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.description.channels import wrench_components
from sms_online.description.schema import Harmonic, System, Trajectory
from sms_online.stream import Array


class References:
    """q_d,i(t) = Σ sine sin(ω t) + cosine (cos(ω t) - 1): starts at 0, and unless Σ sine ω = 0 with a step in rate.

    P candidates over the same frequencies ω (K,), rad/s; sine, cosine (P, K, joints), rad (m on a prismatic joint).
    """

    def __init__(self, frequency: Array, sine: Array, cosine: Array) -> None:
        self._frequency, self._sine, self._cosine = frequency, sine, cosine

    def __call__(self, t: Array) -> tuple[Array, Array]:
        """q_d, rad (m), and q̇_d (B, joints) at t (B,), s: B / P consecutive rows for each candidate."""
        P, joints = self._sine.shape[0], self._sine.shape[2]
        phase = (t[:, None] * self._frequency).reshape(P, -1, self._frequency.size)
        sin, cos = np.sin(phase), np.cos(phase)
        q_d = sin @ self._sine + (cos - 1.0) @ self._cosine
        q_d_dot = (cos * self._frequency) @ self._sine - (sin * self._frequency) @ self._cosine
        return q_d.reshape(-1, joints), q_d_dot.reshape(-1, joints)


def fourier_reference(trajectory: Trajectory) -> References:
    """The one reference that a system file describes."""
    return _fourier(trajectory.joints)


def applied_wrenches(system: System) -> References | None:
    """What the simulator applies of the measured wrenches, component by component; None where that is nothing."""
    applied = [wrench.applied.get(name, ()) for wrench in system.wrenches for name in wrench_components(system, wrench)]
    return _fourier(applied) if any(applied) else None


def _fourier(series: Sequence[Sequence[Harmonic]]) -> References:
    terms = [(column, harmonic) for column, own in enumerate(series) for harmonic in own]
    sine, cosine = np.zeros((2, 1, len(terms), len(series)))
    for k, (column, harmonic) in enumerate(terms):
        sine[0, k, column], cosine[0, k, column] = harmonic.sine, harmonic.cosine
    return References(np.array([harmonic.frequency for _, harmonic in terms]), sine, cosine)
