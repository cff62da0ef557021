"""Values and first derivatives from noisy samples: one local polynomial, the same for every channel.

A Savitzky-Golay filter fits a polynomial of degree 8 to the 2M + 1 samples around an instant and reads value and
slope there. It is symmetric, so it has no phase error and the same lag of M samples in every channel; it is exact
for polynomials up to its degree, so a derivative costs nothing where the signal is smooth; and M is its only knob.
Its narrowest member, M = 4, goes through all nine samples: the value passes untouched and the rate is the
eighth-order central difference. (Second-order differences are a larger error than good encoders' noise, and
smoothing too widely before nonlinear products is a model error that no amount of data averages out; so the width
follows from the noise, never from a constant.)

References: Savitzky and Golay, Analytical Chemistry 36 (1964) 1627; Lepski, Theory of Probability and its
Applications 35 (1990) 454; Goldenshluger and Nemirovski, Mathematical Methods of Statistics 6 (1997) 135.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import correlate1d

from sms_online.pipeline.noise import noise_std
from sms_online.pipeline.synchronise import GridSamples
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices

DEGREE = 8
# Half widths M in samples, each about √2 times the one before (noise of the rate down by 1.75 a step). All pass DC
# to -3 dB at 0.26, 0.16, 0.11, 0.077, 0.052, 0.037 of the sample rate; the first passes everything.
HALF_WIDTHS = (4, 6, 9, 13, 19, 28, 40)
# Two windows agree while their difference is at most this much larger than noise alone makes it. Over a thousand
# samples of white noise that ratio scatters by 3 to 10 % (neighbouring wide windows most), the error of the noise
# estimate included.
AGREEMENT = 1.4
# Steps taken back from the widest window that agrees. There the error of smoothing may still reach the noise, yet a
# fit averages noise over thousands of rows and this error over none; one step costs 1.75 in noise and divides the
# error by 20.
UNDERSMOOTHING = 1
# Answers are compared at every fourth sample: closer ones share most of the samples behind them.
COMPARED = 4
# A comparison needs several windows side by side: at least this many times M samples.
SAMPLES_PER_HALF_WIDTH = 8
# Noise below this many roundings of the largest value is rounding: nothing to smooth.
ROUNDINGS = 64.0
# Samples in which σ is estimated and M is chosen. Counted in samples, not seconds, as the accuracy of both is: σ to
# 5 %.
WARM_UP = 1000
# Work that one push may do, in samples filtered for each sample pushed. What waited for M is processed at this pace,
# so that no push takes much longer than the others; estimating the noise or choosing M costs as much as so many
# samples.
PACE = 1.5
DECISION_COST = 512
# Channels move in a window when one spans this many σ in each of its halves; noise alone spans 7.
MOTION = 20.0
# Windows that move before M is fixed: the first motion after rest begins with a jolt, which asks for a narrower filter
# than anything after it.
MOVING_WINDOWS = 3
NEVER = int(np.iinfo(np.int64).max)


@dataclass(frozen=True)
class RateSamples:
    """B consecutive grid samples of one segment, smoothed, with their first derivatives.

    index: (B,) grid index k, time t0 + k / sample_rate. values, rates: (B, C), SI units and SI units per second.
    segment: number of the gap-free segment. half_width: M of the filter they passed, for the propagation of noise.
    """

    index: Indices
    values: Array
    rates: Array
    segment: int
    half_width: int


@lru_cache(maxsize=len(HALF_WIDTHS))
def coefficients(half_width: int) -> tuple[Array, Array]:
    """Weights of value and of slope per sample, each (2M + 1,), to be correlated with the samples.

    By QR on the interval [-1, 1]. scipy.signal.savgol_coeffs works on sample numbers, where the condition number of
    degree 8 passes 1e13: at M = 40 its weights are wrong by 8e-5.
    """
    z = np.arange(-half_width, half_width + 1) / half_width
    q, r = np.linalg.qr(np.vander(z, DEGREE + 1, increasing=True))
    value, slope = (q @ np.linalg.solve(r.T, np.eye(DEGREE + 1)[:, :2])).T
    # Exactly symmetric and antisymmetric: no phase, not even of rounding.
    return (value + value[::-1]) / 2.0, (slope - slope[::-1]) / (2.0 * half_width)


def smooth_and_differentiate(values: Array, half_width: int, sample_rate: float) -> tuple[Array, Array]:
    """Smoothed values and rates (B - 2M, C) of samples (B, C), for the centres that have M samples on either side.

    scipy.ndimage.correlate1d sums every output in the same order wherever a block begins, so the bits do not depend
    on how samples are split; a matrix product is up to four times faster at M = 40 and slower at M = 6, and its
    bits follow its shape.
    """
    inner = slice(half_width, values.shape[0] - half_width)
    value, slope = coefficients(half_width)
    rates = correlate1d(values, slope * sample_rate, axis=0, mode="nearest")[inner]
    if half_width == HALF_WIDTHS[0]:
        return values[inner], rates
    return correlate1d(values, value, axis=0, mode="nearest")[inner], rates


def choose_half_width(values: Array, sigma: Array) -> int:
    """Half width M for channels values (B, C) with white noise sigma (C,), by Lepski's rule, taken back one step.

    The widest window whose value and slope still agree, in every channel, with those of each narrower window: the
    rms of their difference is within AGREEMENT of what noise alone leaves of it, σ ‖h_M - h_M'‖. Channels that do
    not move have no say. A moving channel without noise asks for the narrowest window. B limits the widest window
    that is tried.
    """
    moving = np.ptp(values, axis=0) > 0.0
    values, sigma = values[:, moving], sigma[moving]
    if np.any(sigma <= ROUNDINGS * np.spacing(np.abs(values).max(axis=0))):
        return HALF_WIDTHS[0]
    widths = [M for M in HALF_WIDTHS if HALF_WIDTHS[0] == M or values.shape[0] >= SAMPLES_PER_HALF_WIDTH * M]
    windows = sliding_window_view(values, 2 * widths[-1] + 1, axis=0)[::COMPARED]  # (n, C, 2 M_max + 1)
    tried: list[tuple[Array, Array]] = []
    for half_width in widths:
        margin = widths[-1] - half_width
        kernels = np.array(coefficients(half_width))
        answers = windows[:, :, margin : windows.shape[2] - margin] @ kernels.T
        kernels = np.pad(kernels, ((0, 0), (margin, margin)))
        if not all(_agree(kernels - narrower, answers - theirs, sigma) for narrower, theirs in tried):
            break
        tried.append((kernels, answers))
    return HALF_WIDTHS[max(len(tried) - 1 - UNDERSMOOTHING, 0)]


def _agree(leftover: Array, difference: Array, sigma: Array) -> bool:
    """Whether noise can explain the difference (n, C, 2) of two windows whose kernels differ by leftover (2, ·)."""
    expected = np.linalg.norm(leftover, axis=1) * sigma[:, None]
    found = np.sqrt(np.mean(np.square(difference), axis=0))
    return bool(np.all(found <= AGREEMENT * expected))


class RatesState(State):
    """What the filter keeps, and what it has chosen.

    half_width: M. sigma (C,): white noise, 1σ per sample. buffer (B, C): samples from grid index `start` on. next:
    grid index of the next sample to deliver. decided: index up to which half_width holds. noise_known: of the window
    that is being decided. moved: windows that moved throughout.
    """

    sigma: Array
    buffer: Array
    half_width: int = HALF_WIDTHS[0]
    segment: int = -1
    start: int = 0
    next: int = 0
    decided: int = 0
    noise_known: bool = False
    moved: int = 0


class RatesStage(Stage):
    """Smoothed values and rates of all columns, behind the same lag of M samples.

    The third window of WARM_UP samples in which the channels move throughout fixes M for good. Windows before it, at
    rest, with the onset of motion or its first jolt, get an M of their own: a choice made at rest would be blind to the
    motion to come. Until M is fixed samples wait for their window to fill; none is lost, except the first and last M of
    a segment, which have no full filter.
    Limitation: motion much faster than that window's is smoothed by its M.

    sample_rate: Hz. deciding: columns that have a say in M (positions, not torques). sigma: (C,) stated white
    noise, 1σ per sample, NaN where it is to be estimated.
    """

    def __init__(self, sample_rate: float, deciding: Sequence[int], sigma: Array) -> None:
        self.sample_rate = sample_rate
        self._stated = sigma.copy()
        self._deciding = np.array(deciding, dtype=np.int64)
        self.state = RatesState(sigma.copy(), np.empty((0, sigma.size)))

    @property
    def sigma(self) -> Array:
        """White noise of each column (C,), 1σ per sample."""
        return self.state.sigma

    @property
    def fixed(self) -> bool:
        """Whether M and the noise (sigma) are fixed for the rest of the capture."""
        return self.state.moved >= MOVING_WINDOWS

    def push(self, samples: GridSamples) -> list[RateSamples]:
        """Take consecutive grid samples and return those that have become final."""
        pieces: list[RateSamples] = []
        if samples.segment != self.state.segment:
            pieces = self.flush()
            self.state.segment = samples.segment
            self.state.start = self.state.next = int(samples.index[0])
            self.state.decided = NEVER if self.fixed else self.state.start
        self.state.buffer = np.concatenate([self.state.buffer, samples.values])
        return pieces + self._advance(int(PACE * samples.index.size) + 1)

    def flush(self) -> list[RateSamples]:
        """End of a segment or of the capture: return what has a full filter."""
        pieces = self._advance(NEVER)
        rest = self.state.buffer[max(self.state.decided - self.state.start, 0) :]
        if not self.fixed and rest.shape[0] >= SAMPLES_PER_HALF_WIDTH * HALF_WIDTHS[1]:
            self._estimate_noise(rest)
            self._choose(rest)
        self.state.decided, self.state.noise_known = NEVER, False
        pieces += self._deliver(NEVER)
        self.state.buffer = self.state.buffer[:0]
        self.state.segment = -1
        return pieces

    def _advance(self, budget: int) -> list[RateSamples]:
        """Deliver and decide, as far as the samples reach and the budget lasts."""
        pieces: list[RateSamples] = []
        while budget > 0:
            delivered = self._deliver(budget)
            if delivered:
                pieces += delivered
                budget -= delivered[0].index.size
            elif self._window_is_full and (budget >= DECISION_COST or not pieces):
                offset = self.state.decided - self.state.start
                self._decide(self.state.buffer[offset : offset + WARM_UP])
                budget -= DECISION_COST
            else:
                break
        return pieces

    @property
    def _window_is_full(self) -> bool:
        """Whether the samples that wait for M are enough to decide on it."""
        return not self.fixed and self.state.start + self.state.buffer.shape[0] - WARM_UP >= self.state.decided

    def _decide(self, window: Array) -> None:
        """One step towards M for a full window: first its noise, then M."""
        if not self.state.noise_known:
            self._estimate_noise(window)
            self.state.noise_known = True
            return
        self._choose(window)
        self.state.noise_known = False
        self.state.moved += self._moves_throughout(window)
        self.state.decided = NEVER if self.fixed else self.state.decided + WARM_UP

    def _estimate_noise(self, window: Array) -> None:
        estimate = np.isnan(self._stated)
        sigma = self._stated.copy()
        sigma[estimate] = noise_std(window[:, estimate])
        self.state.sigma = sigma

    def _choose(self, window: Array) -> None:
        self.state.half_width = choose_half_width(window[:, self._deciding], self.state.sigma[self._deciding])

    def _moves_throughout(self, window: Array) -> bool:
        halves = np.array_split(window[:, self._deciding], 2)
        span = np.array([np.ptp(half, axis=0) for half in halves])
        return bool(np.any(np.all(span > MOTION * self.state.sigma[self._deciding], axis=0)))

    def _deliver(self, most: int) -> list[RateSamples]:
        """Filter what half_width holds for and has M samples on either side, at most `most`; drop what is done with."""
        now = self.state
        first = max(now.next, now.start + now.half_width)
        stop = min(now.decided, now.start + now.buffer.shape[0] - now.half_width)
        stop = min(stop, first + most) if most < NEVER else stop
        if stop <= first:
            return []
        rows = now.buffer[first - now.half_width - now.start : stop + now.half_width - now.start]
        values, rates = smooth_and_differentiate(rows, now.half_width, self.sample_rate)
        now.next = stop
        reach = now.half_width if self.fixed else HALF_WIDTHS[-1]
        drop = max(stop - reach - now.start, 0)
        now.buffer, now.start = now.buffer[drop:].copy(), now.start + drop
        return [RateSamples(np.arange(first, stop), values, rates, now.segment, now.half_width)]
