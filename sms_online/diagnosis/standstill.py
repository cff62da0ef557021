"""Where a motor, or a joint, is at rest in a whole session."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from sms_online.diagnosis.record import Segment
from sms_online.effects.base import position
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.standstill import Standstill, rate_filter
from sms_online.stream import Array, Indices, Mask

# Before breakaway an axis is held by what its law gives so long before its motion shows, s.
LEAVING = 0.025


class SessionStandstill:
    """Where one axis is at rest in a session.

    axis: number of its speed. noise: σ of its position, rad.
    """

    def __init__(
        self, sensing: Sensing, segments: Sequence[Segment], axis: int, noise: float, sample_rate: float
    ) -> None:
        layout = sensing.model.layout
        self.axis = axis
        self._still, self._leaving = [], []
        for segment in segments:
            angle = position(layout, sensing.coordinates(segment.values), axis)
            still = Standstill(1, sample_rate)
            still.push(angle[:, None], np.array([noise]))
            self._still.append(still.at(np.arange(angle.size))[:, 0])
            self._leaving.append(_leaving(self._still[-1], angle, sample_rate))

    @cached_property
    def share(self) -> float:
        """Share of the session in which the axis is at rest."""
        return float(np.mean(np.concatenate(self._still)))

    def at(self, number: int, samples: Indices) -> Mask:
        """At which samples (K,) of a segment the axis is at rest."""
        return self._still[number][samples]

    def leaving(self, number: int, samples: Indices) -> Array:
        """Sign (K,) of the motion after breakaway at samples (K,) just before it, zero elsewhere."""
        return self._leaving[number][samples]


def _leaving(still: Mask, angle: Array, sample_rate: float) -> Array:
    """See `SessionStandstill.leaving`, for all samples of a segment."""
    out = np.zeros(still.size)
    beyond = rate_filter(sample_rate)
    for end in (np.flatnonzero(np.diff(still.astype(np.int8)) < 0) + 1).tolist():
        # A filter that reaches so far detects standstill, which lasts for longer than this.
        out[end - round(LEAVING * sample_rate) : end] = np.sign(angle[end + beyond] - angle[end])
    return out
