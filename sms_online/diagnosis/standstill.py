"""Where an axis stands still: there dry friction takes any value up to what breaks it loose, and no law says which."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sms_online.diagnosis.record import Segment
from sms_online.effects.base import position
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.smoothing import HALF_WIDTHS, kernel, smooth

# An axis stands still where its rate is below this multiple of the rate's noise for so long, s. At a reversal it is for
# less, unless it sticks there, or is turned round by less than 1 rad/s² (noise of 1e-4 rad at 1 kHz).
STILL, LASTING = 4.0, 0.06
# Half width of the filter of that rate, s; it is told once in so many samples.
HALF_WIDTH, STEP = 0.028, 4


class Standstill:
    """Where one motor stands still in a session.

    joint: of the motor, by number from 0. noise: σ of its position, rad. slow: the rate below which it stands still,
    rad/s.
    """

    def __init__(
        self, sensing: Sensing, segments: Sequence[Segment], joint: int, noise: float, sample_rate: float
    ) -> None:
        layout = sensing.model.layout
        self.motor = layout.theta_m[joint]
        M = max(HALF_WIDTHS[0], round(HALF_WIDTH * sample_rate))
        self.slow = STILL * noise * float(np.linalg.norm(kernel(M)[:, 1])) * sample_rate
        self._still = []
        for segment in segments:
            angle = position(layout, sensing.coordinates(segment.values), self.motor)[:, None]
            seen = np.arange(M, len(angle) - M, STEP)
            rate = smooth(angle, seen, M, sample_rate)[1][:, 0]
            edges = np.flatnonzero(np.diff(np.abs(rate) < self.slow, prepend=False, append=False))
            still = np.zeros(len(seen), dtype=bool)
            for begin, end in edges.reshape(-1, 2).tolist():
                still[begin:end] = seen[end - 1] - seen[begin] >= LASTING * sample_rate
            self._still.append((seen, still))

    @cached_property
    def share(self) -> float:
        """Share of the session in which it does."""
        return float(np.mean(np.concatenate([still for _, still in self._still])))

    def at(self, number: int, samples: NDArray[np.int64]) -> NDArray[np.bool_]:
        """At which samples (K,) of a segment it does."""
        seen, still = self._still[number]
        return still[np.clip(np.searchsorted(seen, samples), 0, len(seen) - 1)]
