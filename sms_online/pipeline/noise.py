"""White measurement noise, estimated from the samples themselves.

Differencing d times multiplies white noise by √C(2d, d) and a component of frequency f by (2 sin(π f / f_s))^d. A
signal well below f_s / 6 therefore dies out as d grows while noise does not, and what remains is the noise (Rice
1984; Gasser, Sroka and Jennen-Steinmetz 1986; for growing orders Seifert, Gasser and Wolf 1993). Where the steps in
time are unequal, divided differences take the place of differences: they remove polynomials of the same degree.
"""

from __future__ import annotations

from functools import cache
from math import comb

import numpy as np

from sms_online.stream import Array

# 30 Hz at 1 kHz shrinks about tenfold an order, so sixteen orders bring it from 1 to rounding.
MAX_ORDER = 16
# The next order is tried while it lowers the estimate by more than this share: what is left of a signal that still
# falls at least twofold an order is then below a quarter of the noise, 3 % of the estimate, less than its scatter
# over 1000 samples.
STILL_FALLING = 0.97
# Steps are equal when none is further than this share from the median: at 1 kHz that is 1 µs, in which 1 rad/s moves a
# tenth of a good encoder's noise.
EQUAL_STEPS = 1e-3
# Median absolute deviation of a unit normal distribution.
NORMAL_MAD = 0.674489750196082
# Differences beyond so many standard deviations are jumps, and the variance of a unit normal distribution within them.
OUTLIER = 3.0
NORMAL_INSIDE = 0.9733369246625415
# Fewer levels than this may be a switched command rather than a measured quantity on a grid of its sensor.
LEAST_LEVELS = 8
# Steps are multiples of one quantum when none is further than this share of it from one. A thousand steps of a
# continuous signal do not pass by accident; steps whose rounding could exceed it are not judged.
QUANTUM_TOLERANCE = 1e-2
# Noise is coloured when the density at f_s / 8 is so many times that at f_s / 2; of white noise it scatters by a tenth.
COLOURED = 1.5
# Natural logarithm of a ratio of densities within which it is that of first-order noise.
CONSISTENT = 0.35
# Samples in a mean, the first of them to ask whether there is any colour; and fewest means. Where these show noise of
# first order, longer means say how slow it is, up to those that hold a signal: they are off by more than their scatter.
MEANS = (4, 2, 8)
LONG_MEANS = (16, 32, 64)
LONG_CONSISTENT = 0.7
FEWEST_MEANS = 60
# Order of differences at which noise of such colour is distinguished from a slower signal.
TYPICAL_ORDER = 4
_CORRELATIONS = np.linspace(0.0, 1.0, 1001)[:-1]


def noise_std(values: Array, times: Array | None = None) -> Array:
    """1σ of the white noise of each channel, (C,), from consecutive samples, values (B, C).

    times (B,): their instants, s, ascending; None on a uniform grid. The spread is the root mean square of the
    differences within three standard deviations by their median absolute deviation: a few jumps do not count.
    Where more than half of the differences vanish it is their plain root mean square. A channel whose values lie on a
    grid of width r has at least the rounding noise r/√12 (and up to twice that where it creeps from level to level). A
    constant channel has none. Scatter of the estimate about 3.5 % over 1000 samples.
    Limitations: a signal above f_s / 6 counts as noise; noise that a sensor has low-passed is seen only by its
    level there.
    Raises ValueError with fewer than MAX_ORDER + 2 samples.
    """
    if values.shape[0] < MAX_ORDER + 2:
        raise ValueError(f"{values.shape[0]} samples are too few for differences of order {MAX_ORDER}")
    steps = _Steps() if times is None or _equal(times) else _UnequalSteps(times)
    difference, unit = steps.difference(values)
    sigma = _spread(difference / unit)
    falling = np.flatnonzero(sigma)
    difference = difference[:, falling]
    for _ in range(2, MAX_ORDER + 1):
        difference, unit = steps.difference(difference)
        spread = _spread(difference / unit)
        goes_on = spread < STILL_FALLING * sigma[falling]
        sigma[falling] = np.minimum(spread, sigma[falling])
        falling, difference = falling[goes_on], difference[:, goes_on]
        if falling.size == 0:
            break
    rounding = np.array([_quantum(values[:, c]) for c in range(values.shape[1])]) / np.sqrt(12.0)
    noise: Array = np.maximum(sigma, rounding)
    return noise


def rough_part(values: Array, times: Array, order: int) -> Array:
    """What differences of an order leave of samples (B, C) at times (B,), in units of one sample (B - order, C)."""
    steps = _Steps() if _equal(times) else _UnequalSteps(times)
    difference, unit = steps.difference(values)
    for _ in range(order - 1):
        difference, unit = steps.difference(difference)
    return np.asarray(difference / unit)


def correlation(values: Array, sigma: float) -> float:
    """Correlation a from one sample to the next of a channel's first-order noise, from its samples (B,); 0 if white.

    sigma: what `noise_std` says of them. Differences of means of m samples see the noise's density near f_s / 2m. Those
    of a first-order process, e_{k+1} = a e_k + white noise, have ratios that depend on a alone. Where they do not,
    the slower bands hold the signal, and nothing is known of the noise's colour there: 0.
    """
    if values.size < max(MEANS) * FEWEST_MEANS or sigma == 0.0:
        return 0.0
    ratios = np.zeros(len(MEANS))
    for k, m in enumerate(MEANS):
        ratios[k] = _density(values, m) / sigma**2
        if k == 0 and ratios[k] < COLOURED:
            return 0.0
    off = _off(ratios, MEANS)
    best = int(np.argmin(np.sum(off**2, axis=0)))
    if np.any(np.abs(off[:, best]) >= CONSISTENT):
        return 0.0
    for m in LONG_MEANS:
        if values.size < m * FEWEST_MEANS:
            break
        longer = np.concatenate((off, _off(np.array([_density(values, m) / sigma**2]), (m,))))
        at = int(np.argmin(np.sum(longer**2, axis=0)))
        if np.any(np.abs(longer[:, at]) >= LONG_CONSISTENT):
            break
        off, best = longer, at
    return float(_CORRELATIONS[best])


def _density(values: Array, m: int) -> float:
    """Density of noise near f_s / 2m, in units of that of white noise of unit variance, from means of m samples."""
    means = values[: values.size // m * m].reshape(-1, m).mean(axis=1)
    return m * float(noise_std(means[:, None])[0]) ** 2


def _off(ratios: Array, means: tuple[int, ...]) -> Array:
    """Logarithms (M, ·) of what first-order noise of each correlation has there over ratios (M,) to single samples."""
    expected = np.array([_seen_densities(m) for m in means]) / _seen_densities(1)
    return np.asarray(np.log(expected) - np.log(ratios)[:, None])


@cache
def _seen_densities(m: int) -> Array:
    return _seen_density(_CORRELATIONS, m)


def density_gain(a: float, frequency: float) -> float:
    """Density of first-order noise of correlation a at a frequency, in units of f_s, over that of `noise_std`."""
    density = (1.0 - a**2) / (1.0 + a**2 - 2.0 * a * np.cos(2.0 * np.pi * frequency))
    return float(density / _seen_density(np.array([a]), 1)[0])


def _seen_density(a: Array, m: int) -> Array:
    """What differences of means of m samples see of first-order noise of unit variance, with each correlation a."""
    weight = np.repeat([(-1.0) ** k * comb(TYPICAL_ORDER, k) for k in range(TYPICAL_ORDER + 1)], m) / m
    of_lag = np.correlate(weight, weight, mode="full")[weight.size - 1 :]
    of_lag[1:] *= 2.0
    return np.asarray(m * np.polynomial.polynomial.polyval(a, of_lag) / comb(2 * TYPICAL_ORDER, TYPICAL_ORDER))


def _equal(times: Array) -> bool:
    step = np.diff(times)
    middle = np.median(step)
    return bool(np.all(np.abs(step - middle) <= EQUAL_STEPS * middle))


class _Steps:
    """Differences of growing order between samples at equal steps."""

    def __init__(self) -> None:
        self._order = 0

    def difference(self, before: Array) -> tuple[Array, Array]:
        """The next order (B - 1, C) from the order before (B, C), and 1σ (1, 1) that unit noise makes of it."""
        self._order += 1
        return np.diff(before, axis=0), np.full((1, 1), np.sqrt(comb(2 * self._order, self._order)))


class _UnequalSteps:
    """Divided differences of growing order between samples at times (B,)."""

    def __init__(self, times: Array) -> None:
        # In mean steps: divided differences then neither vanish nor overflow.
        self._times = (times - times[0]) * ((times.size - 1) / (times[-1] - times[0]))
        self._weights = np.ones((times.size, 1))  # of the samples in each difference

    def difference(self, before: Array) -> tuple[Array, Array]:
        """The next order (B - 1, C) from the order before (B, C), and 1σ (B - 1, 1) that unit noise makes of it."""
        order = self._weights.shape[1]
        reach = (self._times[order:] - self._times[:-order])[:, None]
        weights = np.zeros((reach.size, order + 1))
        weights[:, 1:] = self._weights[1:]
        weights[:, :-1] -= self._weights[:-1]
        self._weights = weights / reach
        return np.diff(before, axis=0) / reach, np.linalg.norm(self._weights, axis=1, keepdims=True)


def _spread(difference: Array) -> Array:
    """1σ of each column about zero: differences of a smooth signal have no mean worth keeping."""
    magnitude = np.abs(difference)
    # The upper median by partition: several times faster than numpy.median, and all the same over so many samples.
    middle = magnitude.shape[0] // 2
    robust: Array = np.partition(magnitude.T.copy(), middle, axis=1)[:, middle] / NORMAL_MAD
    # The root mean square of what is no outlier by it scatters by a quarter less.
    inside = magnitude <= OUTLIER * robust
    mean_square = np.sum(np.square(magnitude), axis=0, where=inside) / np.maximum(1, np.count_nonzero(inside, axis=0))
    robust = np.sqrt(mean_square / NORMAL_INSIDE)
    still = robust == 0.0
    robust[still] = np.sqrt(np.mean(magnitude[:, still] ** 2, axis=0))
    return robust


def _quantum(channel: Array) -> float:
    """Width of the grid that all values of a channel (B,) lie on; 0 where there is none."""
    levels = np.unique(channel)
    if levels.size < LEAST_LEVELS:
        return 0.0
    rounding = 4.0 * float(np.spacing(np.max(np.abs(levels))))
    steps = np.diff(levels)
    remainder = steps[steps > rounding]
    # Euclid's algorithm on all steps at once; without a grid the remainders sink into the rounding within a few
    # rounds.
    quantum = 0.0
    while remainder.size:
        quantum = float(remainder.min())
        multiple = np.rint(steps / quantum)
        if rounding * multiple.max() > QUANTUM_TOLERANCE * quantum:
            return 0.0
        misfit = np.abs(steps - quantum * multiple)
        remainder = misfit[misfit > QUANTUM_TOLERANCE * quantum]
    return quantum
