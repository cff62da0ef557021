"""Where an axis stands still: there dry friction takes any value up to what breaks it loose, and no law says which."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_online.diagnosis.followed import FollowedMotion
from sms_online.pipeline.smoothing import kernel

# An axis stands still where its rate is below this multiple of the rate's noise for so long, s: half a usual window. At
# a reversal it is for less, unless the axis is turned round by less than a third of a rad/s².
STILL, LASTING = 4.0, 0.2


class Standstill:
    """Where one motor stands still in a session.

    motion: of the whole session. motor: its index in the speeds. noise: σ of its position, rad. slow: the rate below
    which it stands still, rad/s.
    """

    def __init__(self, motion: FollowedMotion, motor: int, noise: float, sample_rate: float) -> None:
        self.motor, self._motion = motor, motion
        self.slow = STILL * noise * float(np.linalg.norm(kernel(motion.half_width)[:, 1])) * sample_rate
        self._least = LASTING * sample_rate

    def at(self, number: int, samples: NDArray[np.int64]) -> NDArray[np.bool_]:
        """At which samples (K,) of a segment it does."""
        seen, v = self._motion.speeds(number)
        edges = np.flatnonzero(np.diff(np.abs(v[:, self.motor]) < self.slow, prepend=False, append=False))
        still = np.zeros(len(seen), dtype=bool)
        for begin, end in edges.reshape(-1, 2).tolist():
            still[begin:end] = seen[end - 1] - seen[begin] >= self._least
        return still[np.clip(np.searchsorted(seen, samples), 0, len(seen) - 1)]
