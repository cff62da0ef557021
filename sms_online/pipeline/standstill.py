"""Where an axis is at rest or turns back: there dry friction takes any value up to breakaway, and no law says which.

Laws are evaluated with a filtered rate. It does not change its sign when the axis does, for friction makes the rate's
slope jump there: the impulse that a law is then off by goes with that jump, as a rotor's inertia does.
"""

from __future__ import annotations

import numpy as np

from sms_online.pipeline.smoothing import HALF_WIDTHS, kernel, smooth_all
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices, Mask

# An axis is at rest where its rate is below this multiple of the rate's noise for so long, s. At a reversal it is for
# less, unless it sticks there, or is turned round by less than 1 rad/s² (noise of 1e-4 rad at 1 kHz).
STILL, LASTING = 4.0, 0.06
# Half width of the filter of that rate, s.
HALF_WIDTH = 0.028


def rate_filter(sample_rate: float) -> int:
    """Half width of the filter of the rate that shows a standstill, samples."""
    return max(HALF_WIDTHS[0], round(HALF_WIDTH * sample_rate))


def slowest(noise: float, half_width: int, sample_rate: float) -> float:
    """Rate below which an axis may be at rest, rad/s (m/s), for a position's noise of 1σ a sample and its filter."""
    return STILL * noise * float(np.linalg.norm(kernel(half_width)[:, 1])) * sample_rate


def lasting(slow: Mask, sample_rate: float) -> Mask:
    """Samples at which an axis is slow for long, of samples (K,) at which it is slow."""
    still = np.zeros_like(slow)
    for begin, end in np.flatnonzero(np.diff(slow, prepend=False, append=False)).reshape(-1, 2).tolist():
        still[begin:end] = end - 1 - begin >= LASTING * sample_rate
    return still


def turns(rates: Array) -> Mask:
    """Samples (K, D) on either side of a change of the sign of rates (K, D)."""
    changes = np.signbit(rates[1:]) != np.signbit(rates[:-1])
    out = np.zeros(rates.shape, dtype=np.bool_)
    out[1:] |= changes
    out[:-1] |= changes
    return out


class StandstillState(State):
    """What is kept of a motion.

    angles (B, D): from number `first` on. still, turning (·, D): from a filter's half width of samples after that on.
    """

    angles: Array
    still: Mask
    turning: Mask
    first: int = 0


class Standstill(Stage):
    """Where motors (D,) are at rest along one gap-free motion, as far as its samples show by now.

    samples are numbered from 0.
    """

    def __init__(self, motors: int, sample_rate: float) -> None:
        self._rate, self._half_width = sample_rate, rate_filter(sample_rate)
        none = np.empty((0, motors), dtype=bool)
        self.state = StandstillState(np.empty((0, motors)), none, none)

    def push(self, angles: Array, noise: Array) -> None:
        """Take the next angles (B, D); noise (D,): of each, 1σ per sample."""
        M = self._half_width
        self.state.angles = np.concatenate((self.state.angles, angles))
        if len(self.state.angles) <= 2 * M:
            return
        rates = smooth_all(self.state.angles, M, self._rate)[1]
        limits = [slowest(sigma, M, self._rate) for sigma in noise.tolist()]
        self.state.still = np.stack([lasting(slow, self._rate) for slow in (np.abs(rates) < limits).T], axis=1)
        self.state.turning = turns(rates)

    def at(self, samples: Indices) -> Mask:
        """Whether the axes are at rest at samples (K,), (K, D); what is not known yet is as what is known last."""
        return self._seen(self.state.still, samples)

    def turning(self, samples: Indices) -> Mask:
        """Whether they turn back there (K, D), likewise."""
        return self._seen(self.state.turning, samples)

    def _seen(self, mask: Mask, samples: Indices) -> Mask:
        if not len(mask):
            return np.zeros((samples.size, mask.shape[1]), dtype=bool)
        return np.asarray(mask[np.clip(samples - self.state.first - self._half_width, 0, len(mask) - 1)])

    def drop(self, before: int) -> None:
        """Forget what no request for samples from number `before` on needs."""
        now = self.state
        # The newest rates are as far behind as the filter reaches, and what they have lasted follows from them.
        reach = 2 * self._half_width + round(LASTING * self._rate) + 1
        drop = max(0, before - reach - now.first)
        now.angles, now.first = now.angles[drop:], now.first + drop
        now.still, now.turning = now.still[drop:], now.turning[drop:]
