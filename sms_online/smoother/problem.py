"""What fits a span of a session: its samples as a `Span`, and a `SpanSmoother` with the noise of these."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.model.readings import Readings
from sms_online.pipeline.sensing import Sensing
from sms_online.smoother.first_motion import FirstMotion
from sms_online.smoother.fit import SpanSmoother
from sms_online.smoother.gatherer import Gatherer
from sms_online.smoother.gauss_newton import DivergedError
from sms_online.smoother.nuisances import ReadingNuisances
from sms_online.smoother.span import Span
from sms_online.stream import Array


class SpanProblem:
    """Makes the problems of one model and its base parameters. channels: of the session's readings."""

    def __init__(self, model: Model, base: BaseParameters, sensing: Sensing, channels: Sequence[str]) -> None:
        self.model, self.base, self._channels = model, base, tuple(channels)
        self.readings = ReadingNuisances(model, self._channels)
        self._first_motion = FirstMotion(model, sensing, self._channels)

    def __call__(
        self, gathered: Gatherer, count: int, sigma: Array, density: Array, torque_noise: float
    ) -> tuple[SpanSmoother, Span]:
        """What fits the first `count` torques gathered, and the span of these.

        sigma (channels,): noise of the readings, NaN of those that are not used. density (joints,): of the torques'
        noise, (N m)² s; torque_noise: times that. DivergedError where there is no motion to begin with.
        """
        t, torque = gathered.torques(count)
        _, _, sampled, values = gathered.span(count)
        sensed = np.flatnonzero(np.isfinite(sigma))
        readings = Readings(self.model, [self._channels[k] for k in sensed])
        noise = sigma[sensed], density
        smoother = SpanSmoother(
            self.model, self.base, readings, *noise, self.readings, sensed.tolist(), torque_noise
        )  # fmt: skip
        moved, motion = gathered.motion(count)
        if not moved.size:
            raise DivergedError("the sensors give no motion to begin with")
        guess = self._first_motion(moved, motion, sampled, values)
        return smoother, Span(t, torque, sampled, values[:, sensed], *guess)
