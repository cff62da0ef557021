"""Internal states of effects (hysteresis, sloshing liquid) along the measured motion of a whole session."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from sms_online.description.schema import System
from sms_online.diagnosis.record import Segment
from sms_online.model.model import Model
from sms_online.pipeline.internal_states import InternalStates, half_width, smooth_from_the_start
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.smoothing import HALF_WIDTHS
from sms_online.stream import Array, Indices

# States are advanced once in so many samples: at 1 kHz what changes at 3 Hz is computed 80 times a period.
STEP = 4


def least_samples(system: System) -> int:
    """Samples of a segment that give any window, and a motion that internal states can follow."""
    return round(1.5 * system.windows.momentum * system.sample_rate) + 2 * half_width(system)


class FollowedMotion:
    """The smoothed motion of each segment, once in STEP samples, for any model's internal states."""

    def __init__(self, sensing: Sensing, segments: Sequence[Segment], sample_rate: float) -> None:
        self._rate = sample_rate
        layout = sensing.model.layout
        self._motions = []
        self._last: tuple[Model, dict[int, Array]] | None = None
        M = half_width(sensing.model.system)
        self._sizes = [segment.index.size for segment in segments]
        for segment in segments:
            x = sensing.coordinates(segment.values)
            samples = np.arange(M - STEP * ((M - HALF_WIDTHS[0]) // STEP), len(x) - M, STEP)
            smoothed, rates = smooth_from_the_start(x, 0, samples, M, sample_rate)
            self._motions.append((samples, smoothed, layout.speeds(smoothed, rates)))

    def states(self, model: Model, number: int, at: Indices | None = None) -> Array:
        """Internal states (K, n_states) of a model at samples `at` (K,) of a segment, at all of them unless given.

        They begin at rest with the segment, and stay as they are at its ends, where the motion is not known.
        """
        at = np.arange(self._sizes[number]) if at is None else at
        if model.n_states == 0:
            return np.zeros((len(at), 0))
        samples, x, v = self._motions[number]
        # Windows of one segment ask in turn for the same model's.
        if self._last is None or self._last[0] is not model:
            self._last = model, {}
        known = self._last[1]
        if number not in known:
            known[number] = InternalStates(model, self._rate / STEP).push(x, v)
        z = known[number]
        return np.asarray(CubicSpline(samples, z)(np.clip(at, samples[0], samples[-1])))
