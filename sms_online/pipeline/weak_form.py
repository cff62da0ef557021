"""Test functions of the weak form: (33)-(37) times φ of compact support, integrated by parts.

Only positions and speeds appear: -∫ (φ̇ P + φ G) dt π = ∫ φ Q dt.
"""

from __future__ import annotations

import numpy as np

from sms_online.stream import Array


def effective_samples(phi: Array) -> float:
    """Samples of φ (K,) that an integral with it averages over, (Σ φ)² / Σ φ².

    Of a force that is another at each sample with so many times the variance it is as large as of one that stays.
    """
    return float(phi.sum() ** 2 / (phi @ phi))


def test_function(steps: int, span: float, exponent: int) -> tuple[Array, Array, Array]:
    """φ = (1 - z²)^exponent with φ̇ (1/s) and φ̈ (1/s²) at steps + 1 instants of a window of `span` seconds."""
    z = np.linspace(-1.0, 1.0, steps + 1)
    u = 1.0 - z**2
    rate = 2.0 / span
    slope = -2.0 * exponent * z * u ** (exponent - 1)
    curvature = 4.0 * exponent * (exponent - 1) * z**2 * u ** (exponent - 2) - 2.0 * exponent * u ** (exponent - 1)
    return u**exponent, slope * rate, curvature * rate**2
