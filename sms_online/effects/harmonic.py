"""a cos(ψ - φ) as two linear coefficients: a cos φ of cos ψ and a sin φ of sin ψ."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sms_online.stream import Array


def phase_columns(psi: Array) -> Array:
    """cos ψ and sin ψ (B, 2)."""
    return np.stack((np.cos(psi), np.sin(psi)), axis=1)


def nominal_parts(
    symbol: str, index: int, unit: str, given: Mapping[str, float], scale: float = 1.0
) -> dict[str, tuple[str, str, float]]:
    """Linear coefficients, quantity to symbol, unit and nominal value, for a declared amplitude times `scale`."""
    amplitude, phase = scale * given.get("amplitude", 0.0), given.get("phase", 0.0)
    return {
        "cosine": (f"{symbol}_c{index}", unit, float(amplitude * np.cos(phase))),
        "sine": (f"{symbol}_s{index}", unit, float(amplitude * np.sin(phase))),
    }


def amplitude_and_phase(parts: Array) -> dict[str, float]:
    """a and φ (rad, in (-π, π]) of cosine and sine parts (2,)."""
    return {"amplitude": float(np.hypot(*parts)), "phase": float(np.arctan2(parts[1], parts[0]))}
