"""Torques that are noisier than their samples show: what their rows leave does not last from window to window.

Differences of a torque's samples show its noise at high frequencies. Slower noise is seen in what the model leaves
alone. So is a force that the model lacks, and a small one that lasts is hidden by such noise: up to a third of the rms
that is left. So rows of such torques are a reason to doubt.
"""

from __future__ import annotations

from collections.abc import Mapping

from sms_online.row_types import NOISE_WHITENED, Residuals
from sms_online.verdict.reasons import IF_NOTHING, NOISE_RESIDUAL, listed
from sms_online.verdict.trust import Reason

# Digits of a noise to be stated.
DIGITS = 2
# Mark of the reason on the arm.
NOISY = "noisy torque"


def noisy_torques(residual: Residuals, passing: Mapping[str, tuple[str, float]]) -> dict[str, tuple[str, float]]:
    """By type of rows, the torque's channel and the noise of its samples, 1σ, that rows leave; empty where any lasts.

    passing: of rows whose residual does not last, the channel and the noise that is predicted by its samples. A torque
    of which a larger share is left is noisier than any sensor.
    """
    loud = {row: each for row, each in residual.items() if each.whitened is not None and each.whitened > NOISE_WHITENED}
    out = {}
    for row, each in loud.items():
        if row not in passing or each.relative is None or each.relative > NOISE_RESIDUAL:
            return {}
        channel, predicted = passing[row]
        out[row] = channel, predicted * (each.whitened or 0.0)
    return out


def noisier(noisy: Mapping[str, tuple[str, float]], residual: Residuals) -> list[Reason]:
    """Torques that are noisier than predicted, with what to state of them."""
    if not noisy:
        return []
    channels = [channel for channel, _ in noisy.values()]
    most = max(residual[row].whitened or 0.0 for row in noisy)
    text = f"{listed(channels)}: up to {most:.2g} × the noise that samples show"
    full = f"{text}; what they leave does not last from window to window, as a force would that the model lacks"
    stated = ", ".join(f"{channel} {std:.{DIGITS}g}" for channel, std in noisy.values())
    then = f"{IF_NOTHING}if these torques are known to be so noisy, state noise: {stated}"
    return [Reason(text, False, tuple(noisy), NOISY, full, then)]
