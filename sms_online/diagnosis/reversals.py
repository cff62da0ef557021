"""The rate of an axis for forces that jump with its sign, and how well its reversals are located.

At a reversal dry friction bends that rate. A filter as wide as the smooth motion allows rounds off the bend, and
moves the zero of the rate by milliseconds, at every reversal to the same side. So the rate comes through a filter as
narrow as its noise allows. The error that remains follows from that noise, and from a wider filter. An integral over
samples resolves a jump to half a sample only, so forces are averaged over instants between them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from sms_online.diagnosis.record import Segment
from sms_online.diagnosis.standstill import SessionStandstill
from sms_online.diagnosis.weak_windows import SeenMotion
from sms_online.effects.base import STANDSTILL, position
from sms_online.pipeline.rough_forces import WITHIN
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.smoothing import HALF_WIDTHS, kernel, smooth_all
from sms_online.stream import Array, Indices

# What these leave of a jump's place, samples: they are a fifth apart.
RESOLVED = 0.2 / np.sqrt(12.0)
# A reversal is off by no more than this, s: an axis that turns round more slowly is at rest.
LARGEST = 0.06
# Rates on both sides of a jump, in multiples of what counts as standstill.
BESIDE = 10.0


@cache
def _gains(M: int) -> tuple[float, float]:
    """Deviations of a rate, and of what a filter twice as wide changes of it, for unit noise at unit sample rate."""
    own, wide = kernel(M)[:, 1], kernel(2 * M)[:, 1]
    return float(np.linalg.norm(own)), float(np.linalg.norm(wide - np.pad(own, M)))


class Reversals:
    """Rates of one axis.

    noise: σ of its position, rad. standstill: where it is at rest.
    """

    def __init__(
        self, sensing: Sensing, segments: Sequence[Segment], noise: float, sample_rate: float,
        standstill: SessionStandstill,
    ) -> None:  # fmt: skip
        layout = sensing.model.layout
        self._axis = standstill.axis
        self._angles = [position(layout, sensing.coordinates(each.values), self._axis)[:, None] for each in segments]
        self._noise, self._rate, self._standstill = noise, sample_rate, standstill
        self._known: dict[int, list[Array]] = {}

    @cached_property
    def _half_width(self) -> int:
        """Half width of the filter that locates all changes of sign best, which are the more the narrower it is.

        Where the axis is at rest noise alone changes it.
        """
        # Twice the width has to lie within the segments.
        shortest = min(len(angle) for angle in self._angles)
        widths = [M for M in HALF_WIDTHS if shortest > 4 * M + 2] or HALF_WIDTHS[:1]

        def off(M: int) -> float:
            inner = [np.arange(2 * M, len(angle) - 2 * M) for angle in self._angles]
            inner = [samples[~self._standstill.at(k, samples)] for k, samples in enumerate(inner)]
            return float(sum(np.sum(self._turns(k, samples, M)[1] ** 2) for k, samples in enumerate(inner)))

        return min(widths, key=off)

    def _rates(self, segment: int, M: int, at: NDArray[Any]) -> Array:
        """Rates (K,) at samples `at` (K,) of a segment, between whole ones too, rad/s."""
        if M not in self._known:
            # All segments at once, for a search may see a hundred short ones.
            lengths = [len(angle) for angle in self._angles]
            rates = smooth_all(np.concatenate(self._angles), M, self._rate)[1][:, 0]
            firsts = np.cumsum([0, *lengths[:-1]]).tolist()
            ends = zip(firsts, lengths, strict=True)
            self._known[M] = [rates[first : first + max(0, length - 2 * M)] for first, length in ends]
        known = self._known[M][segment]
        return np.asarray(np.interp(at, np.arange(known.size) + M, known))

    def _turns(self, segment: int, samples: Indices, M: int) -> tuple[NDArray[np.intp], Array]:
        """Which of some samples (K,) are the last before a reversal (R,), and what those are off by (R,), samples.

        By noise and by what the filter rounds off. That is in proportion to its width: one of twice the width rounds
        off as much again.
        """
        rate = self._rates(segment, M, samples)
        turns = np.flatnonzero((np.diff(np.sign(rate)) != 0.0) & (np.diff(samples) == 1))
        alone, between = self._noise_of(M)
        more = self._rates(segment, 2 * M, samples[turns]) - rate[turns]
        deviation = np.sqrt(alone**2 + np.maximum(0.0, more**2 - between**2))
        off = np.hypot(deviation / np.abs(rate[turns + 1] - rate[turns]), RESOLVED)
        return turns, np.minimum(off, LARGEST * self._rate)

    def _noise_of(self, M: int) -> tuple[float, float]:
        """Deviation of the rate by noise, and of what it differs by from that of a filter twice as wide, rad/s."""
        alone, between = (self._noise * self._rate * gain for gain in _gains(M))
        return alone, between

    def mean(self, force: Callable[[Array], Array], motion: SeenMotion) -> Array:
        """Forces (K, n_v, c) of speeds (K, n_v), averaged over each sample of a motion."""
        M = min(motion.half_width, self._half_width)
        v = motion.v.copy()
        total: Array | float = 0.0
        for part in WITHIN:
            v[:, self._axis] = self._rates(motion.segment, M, motion.samples + part)
            total = total + force(v)
        return np.asarray(total / len(WITHIN))

    def squares(self, force: Callable[[Array], Array], motion: SeenMotion) -> Array:
        """Squares (K, n_v) of what a force (K, n_v) of speeds is off by, as of one that is off anew at each sample.

        At the samples before a reversal by the jump's place. Elsewhere by what the filter rounds off of the rate, which
        stays for as many samples as it is wide.
        """
        M = min(motion.half_width, self._half_width)
        rate, blur = self._rates(motion.segment, M, motion.samples), self._blur(motion.segment, M)[motion.samples]

        def at(speed: Array | float) -> Array:
            v = motion.v.copy()
            v[:, self._axis] = speed
            return force(v)

        slowest = BESIDE * STANDSTILL
        faster, slower = (np.sign(rate) * np.maximum(np.abs(rate) + off, slowest) for off in (blur, -blur))
        out = (2 * M + 1) * (0.5 * (at(faster) - at(slower))) ** 2
        turns, off = self._turns(motion.segment, motion.samples, M)
        out[turns] += ((at(slowest) - at(-slowest))[turns] * off[:, None]) ** 2
        return np.asarray(out)

    def _blur(self, segment: int, M: int) -> Array:
        """What the filter rounds off of the rate around each sample of a segment (B,), rad/s: see `_turns`."""
        every = np.arange(len(self._angles[segment]))
        more = self._rates(segment, 2 * M, every) - self._rates(segment, M, every)
        return np.sqrt(np.maximum(0.0, uniform_filter1d(more**2, 2 * M + 1) - self._noise_of(M)[1] ** 2))
