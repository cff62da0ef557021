"""Joints whose two encoders agree: a mistake of one of them alone would set them apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.diagnosis.record import Segment
from sms_online.diagnosis.sample_mistakes import MistakeHypothesis, other_encoder
from sms_online.stream import Array

# Two encoders agree whose difference moves by less than this share of what they move by: a spring's deflection. They
# are apart where it moves by more than that share.
AGREE, APART = 0.1, 0.3


class AgreeingEncoders:
    """The pairs of encoders that agree in some samples."""

    def __init__(self, channels: Sequence[str], segments: Sequence[Segment]) -> None:
        self._channels, self._segments = tuple(channels), list(segments)
        both = [(other_encoder(name), name) for name in channels if name.startswith("theta_m_")]
        at = [(self._channels.index(q), self._channels.index(theta)) for q, theta in both if q in self._channels]
        values = [each.values for each in segments]
        self._agreeing = [pair for pair in at if _apart(values, pair) < AGREE]

    def separated(self, hypothesis: MistakeHypothesis) -> bool:
        """Whether samples without a mistake would have encoders apart that agree with it."""
        if not self._agreeing or hypothesis.system is not None:
            return False
        corrected = [hypothesis.apply(self._channels, each.values) for each in self._segments]
        return any(_apart(corrected, pair) > APART for pair in self._agreeing)


def _apart(values: Sequence[Array], pair: tuple[int, int]) -> float:
    """rms of the difference of two readings in segments (B, channels), over that of the one that moves more."""
    readings = [each[:, pair] for each in values]
    moved = [read - np.nanmean(read, axis=0) for read in readings if np.isfinite(read).all(axis=1).any()]
    if not moved:
        return np.inf
    every = np.concatenate(moved)
    most = np.sqrt(np.nanmean(every**2, axis=0)).max()
    return float(np.sqrt(np.nanmean((every[:, 0] - every[:, 1]) ** 2)) / most) if most > 0.0 else np.inf
