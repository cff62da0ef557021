"""Residuals as they are now, not as they were on average since the session's start."""

from __future__ import annotations

from collections import deque

import numpy as np

from sms_online.pipeline.joint_balance import SquaredResidual
from sms_online.pipeline.statistics import Statistics
from sms_online.stream import Array

# A residual is stated over the last so many seconds: some windows of the balance.
SPAN = 1.0


class RecentResidual:
    """Relative residual of every joint's rows over the last second, with the estimate of now."""

    def __init__(self) -> None:
        self._past: deque[tuple[float, tuple[SquaredResidual, ...]]] = deque()
        self._events = 0

    def push(self, t: float, known: Statistics, beta: Array, nuisances: Array | None = None) -> Array:
        """Shares (joints,) of the measured torque or force that are not explained; NaN where nothing was measured.

        nuisances (m,): found beside β, zeros unless given.
        """
        now = known.joints
        if len(known.events) > self._events:
            # The sums begin anew, with what the event has added.
            self._events = len(known.events)
            self._past.clear()
        self._past.append((t, now))
        while len(self._past) > 1 and self._past[1][0] <= t - SPAN:
            self._past.popleft()
        then = self._past[0][1] if len(self._past) > 1 else (None,) * len(now)
        shares = [each.since(before).relative(beta, nuisances) for each, before in zip(now, then, strict=True)]
        return np.array([np.nan if share is None else share for share in shares])
