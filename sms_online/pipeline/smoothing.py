"""Values and first derivatives for the momentum balance: weighted local polynomials on a ladder of widths.

A row of the weak form passes the motion below some 10 Hz alone, so what a wider filter removes costs it nothing, while
the noise that a narrow one lets through is squared by the products in the columns and biases the estimate. The filter
must also stop what a coarser grid would fold back. A Savitzky-Golay filter does not: its side lobes pass 10 % far
beyond its band. With weights (1 - z²)⁶ on the samples the lobes fall below 1e-4 and the values may be thinned.

The width is chosen for each window on its own by comparing neighbours on the ladder (Lepski, Theory of Probability and
its Applications 35 (1990) 454), so a jolt is followed by a narrow filter and the calm after it by a wide one.
Source of the filter: Cleveland, J. American Statistical Association 74 (1979) 829 (locally weighted regression).
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.lib.stride_tricks import as_strided
from scipy.signal import oaconvolve

from sms_online.stream import Array, Indices

DEGREE = 8
# Exponent of the weights: side lobes below 1e-4 at twice the band.
EXPONENT = 6
# Half widths M in samples, each about √2 times the one before. The first goes through all nine samples (the rate is
# the eighth-order central difference); the last passes 26 Hz at 1 kHz to -3 dB.
HALF_WIDTHS = (4, 7, 10, 14, 20, 28, 40, 57, 80)
# Thinning of smoothed samples, one in so many, by half width: what folds back is below 1e-4 at multiples of the thinned
# rate, where a row is widest open, and 1e-3 within all that the filter passes.
SAMPLES_A_STEP = 7
# Neighbours on the ladder agree in a window while the rms of their difference, channel by channel, is at most this
# times what noise makes it: it scatters by 20 % over a window, and the largest of many channels counts.
AGREEMENT = 1.5


@cache
def kernel(half_width: int) -> Array:
    """Weights (2M + 1, 2) of value and of slope per sample, to be correlated with the samples."""
    z = np.arange(-half_width, half_width + 1) / (half_width + 1.0)
    root = (1.0 - z**2) ** (EXPONENT / 2.0)
    q, r = np.linalg.qr(np.vander(z, DEGREE + 1, increasing=True) * root[:, None])
    value, slope = (q @ np.linalg.solve(r.T, np.eye(DEGREE + 1)[:, :2])).T * root
    # Exactly symmetric and antisymmetric: no phase, not even of rounding.
    value, slope = (value + value[::-1]) / 2.0, (slope - slope[::-1]) / (2.0 * (half_width + 1.0))
    return np.stack((value, slope), axis=1)


def stride(half_width: int, hop: int) -> int:
    """Samples from one smoothed sample to the next: the largest divisor of `hop` that M allows."""
    return max(s for s in range(1, max(1, half_width // SAMPLES_A_STEP) + 1) if hop % s == 0)


def _windows(samples: Array, length: int, first: Indices) -> Array:
    """Runs (n, C, length) of samples (B, C) from rows `first` (n,) on; NumPy's own view for it is slow to make."""
    rows, columns = samples.strides
    shape = len(samples) - length + 1, samples.shape[1], length
    return np.asarray(as_strided(samples, shape, (rows, columns, rows), writeable=False)[first])


def smooth(samples: Array, centres: Indices, half_width: int, sample_rate: float) -> tuple[Array, Array]:
    """Values and rates (n, C) at `centres` (n,), row numbers of samples (B, C), from M samples on either side."""
    both = _windows(samples, 2 * half_width + 1, centres - half_width) @ kernel(half_width)
    return both[..., 0], both[..., 1] * sample_rate


def smooth_all(samples: Array, half_width: int, sample_rate: float) -> tuple[Array, Array]:
    """The same as `smooth` at every centre of samples (B, C), (B - 2M, C): many at once, equal up to rounding."""
    # Correlation is convolution with the kernel reversed.
    reversed_kernel = kernel(half_width)[::-1]
    both = [oaconvolve(samples, column[:, None], mode="valid", axes=0) for column in reversed_kernel.T]
    return np.asarray(both[0]), np.asarray(both[1]) * sample_rate


class WidthChoice:
    """Compares slopes of neighbouring widths on a ladder: who differs by more than noise explains."""

    def __init__(self, half_widths: tuple[int, ...]) -> None:
        self._half_widths = half_widths
        widest = half_widths[-1]
        padded = np.stack([np.pad(kernel(M)[:, 1], widest - M) for M in half_widths], axis=1)
        self._differences = np.diff(padded, axis=1)  # (2 M_max + 1, steps)
        # Variance that unit white noise leaves in each difference.
        self._gain = np.sum(self._differences**2, axis=0)

    def squares(self, samples: Array, centres: Indices) -> Array:
        """Summed squares (steps, C) of the differences at `centres`, in multiples of unit noise's expectation."""
        widest = self._half_widths[-1]
        windows = _windows(samples, 2 * widest + 1, centres - widest)
        return np.asarray(np.sum((windows @ self._differences) ** 2, axis=0).T / self._gain[:, None])

    def widest(self, mean_squares: Array, sigma: Array) -> int:
        """Half width M that every narrower neighbour agrees with, from mean squares (steps, C) and noise (C,)."""
        agree = np.all(mean_squares <= (AGREEMENT * sigma) ** 2, axis=1)
        return self._half_widths[int(np.argmin(np.append(agree, False)))]
