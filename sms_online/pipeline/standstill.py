"""Where an axis stands still: there dry friction takes any value up to what breaks it loose, and no law says which."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_online.pipeline.smoothing import HALF_WIDTHS, kernel

# An axis stands still where its rate is below this multiple of the rate's noise for so long, s. At a reversal it is for
# less, unless it sticks there, or is turned round by less than 1 rad/s² (noise of 1e-4 rad at 1 kHz).
STILL, LASTING = 4.0, 0.06
# Half width of the filter of that rate, s.
HALF_WIDTH = 0.028


def rate_filter(sample_rate: float) -> int:
    """Half width of the filter of the rate that standstill is told by, samples."""
    return max(HALF_WIDTHS[0], round(HALF_WIDTH * sample_rate))


def slowest(noise: float, half_width: int, sample_rate: float) -> float:
    """Rate below which an axis may stand still, rad/s (m/s), for a position's noise of 1σ a sample and its filter."""
    return STILL * noise * float(np.linalg.norm(kernel(half_width)[:, 1])) * sample_rate


def lasting(slow: NDArray[np.bool_], sample_rate: float) -> NDArray[np.bool_]:
    """Of samples (K,) at which an axis is slow, those at which it is for long, beyond the ends too as far as known."""
    least = round(LASTING * sample_rate)
    padded = np.pad(slow, least, mode="edge")
    for begin, end in np.flatnonzero(np.diff(padded, prepend=False, append=False)).reshape(-1, 2).tolist():
        padded[begin:end] = end - begin > least
    return padded[least : least + slow.size]
