"""Where an axis stands still: there dry friction takes any value up to what breaks it loose, and no law says which."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_online.diagnosis.rows import SessionRows
from sms_online.diagnosis.weak_windows import Motion, WeakWindows

# An axis stands still where its rate is below this multiple of the rate's noise for so long, s: a reversal takes less,
# and so do the filters that tell the rate.
STILL, REVERSAL = 4.0, 0.05


class Standstill:
    """Where one motor stands still in a session; motor: its index in the speeds.

    noisy: the rows' windows over the same session with synthetic noise of the sensors added.
    """

    def __init__(self, rows: SessionRows, noisy: WeakWindows, motor: int) -> None:
        self.motor = motor
        pairs = zip(noisy.motions(dense=True), rows.weak.motions(dense=True), strict=True)
        noise = np.concatenate([moved.v[:, motor] - motion.v[:, motor] for (moved, _), (motion, _) in pairs])
        self.slow = STILL * float(np.sqrt(np.mean(np.square(noise))))  # rad/s
        self._least = round(REVERSAL * rows.model.system.sample_rate)

    def at(self, motion: Motion) -> NDArray[np.bool_]:
        """At which samples (K,) it does."""
        edges = np.flatnonzero(np.diff(np.abs(motion.v[:, self.motor]) < self.slow, prepend=False, append=False))
        out = np.zeros(len(motion.v), dtype=bool)
        for begin, end in edges.reshape(-1, 2).tolist():
            out[begin:end] = end - begin >= self._least
        return out
