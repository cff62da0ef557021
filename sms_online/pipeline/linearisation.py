"""The nuisances that rows are linear about: the description's own zeros, until samples show that it is far off.

Rows are of first order in what the description is wrong in. Where the estimate of that is certain and so large that its
second order counts, samples are corrected by it, and the session's rows made again, from its first sample on: a step of
Gauss and Newton. They stay equations of the whole nuisances, N ν + Y β = b + N ν₀, so that tolerances keep their place.
As long as a session is young it remembers its samples for that, and looks at some numbers of windows: so the result
follows from the samples alone, live as in a replay.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec
import numpy as np

from sms_online.calibration.channels import Families, nuisances_of
from sms_online.calibration.correction import Correction
from sms_online.calibration.nuisance import Nuisance
from sms_online.description.schema import Tolerances
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.pipeline.synchronise import GridSamples
from sms_online.state import Stage, State
from sms_online.stream import Array
from sms_online.trackers.interface import Estimate

# A nuisance is linear up to its tolerance by default: beyond first order 50 µs of a motion at 20 rad/s are a millionth.
LINEAR = Tolerances()
# It moves the point from so many of its standard deviations on; once that has moved, a step goes on while it is larger
# than this share of either.
CERTAIN, CONVERGED = 3.0, 0.2
# Nothing that is later than this, s, is so by its clock alone.
LATEST = 0.02
# Time that samples are remembered, s.
REMEMBERED = 30.0
# Steps at each look.
STEPS = 4


class LinearisationState(State):
    """What a linearisation keeps.

    point (m,): nuisances ν₀. samples: since the session began, as they came, none where they are no longer remembered.
    due: windows at the next look; steps: left of the last one.
    """

    point: Array
    due: int
    samples: list[tuple[GridSamples, SensorNoise]] = msgspec.field(default_factory=list)
    remembers: bool = True
    steps: int = STEPS


class Linearisation(Stage):
    """Corrects samples by the point ν₀ (m,), and moves it.

    first: windows at the first look. learns: whether drifts are yet to be learned, and may turn out to be none, so that
    samples are remembered in any case. Those of torques are linear, and geometry stays as described.
    """

    def __init__(
        self, sensing: Sensing, nuisances: Sequence[Nuisance], sample_rate: float, first: int, learns: bool
    ) -> None:
        self._sensing, self._sample_rate = sensing, sample_rate
        clocks = np.array([each.name == "clock" for each in nuisances], dtype=np.bool_)
        self._largest = np.where(clocks, LATEST, np.inf)
        self._movable = np.arange(len(nuisances)) < len(nuisances_of(Families.of(sensing).positions))
        self._linear = np.array([getattr(LINEAR, each.name) or 0.0 for each in nuisances], dtype=np.float64)
        remembers = bool(self._movable.any()) or learns
        self.state = LinearisationState(np.zeros(len(nuisances)), first, remembers=remembers)
        self._correction = self._new_correction()

    def _new_correction(self) -> Correction:
        return Correction(self._sensing, self._sample_rate, self.state.point)

    def renew(self) -> None:
        """See Stage."""
        self._correction = self._new_correction()

    @property
    def point(self) -> Array:
        """ν₀ (m,)."""
        return self.state.point

    def push(self, piece: GridSamples, noise: SensorNoise) -> list[GridSamples]:
        """The samples that can be corrected by now. noise: of the sensors, as known now."""
        if self.state.remembers:
            self.state.samples.append((piece, noise))
            if piece.index[-1] - self.state.samples[0][0].index[0] > REMEMBERED * self._sample_rate:
                self.forget()
        return self._correction.push(piece)

    def go_back(self, point: Array) -> None:
        """Take a point (m,) of before."""
        self.state.point = point

    def forget(self) -> None:
        """Stay at this point from now on."""
        self.state.samples, self.state.remembers = [], False

    def begin(self, samples: GridSamples) -> GridSamples:
        """Go on from samples of one segment, which come once more; give those that can be corrected by now."""
        self.forget()
        self._correction = self._new_correction()
        ready = self._correction.push(samples) if samples.index.size else []
        return ready[0] if ready else GridSamples(samples.index[:0], samples.values[:0], samples.segment)

    def again(self) -> Iterator[tuple[GridSamples, SensorNoise]]:
        """All samples so far, corrected anew, with the noise that was known then."""
        self._correction = self._new_correction()
        for piece, noise in self.state.samples:
            for corrected in self._correction.push(piece):
                yield corrected, noise

    def looks(self, windows: int, last: bool) -> bool:
        """Whether to look at the estimate of so many windows; last: no more samples come."""
        now = self.state
        if not now.remembers:
            return False
        if last or windows >= now.due:
            now.due, now.steps = 2 * now.due, STEPS
            return True
        return False

    def moves(self, estimate: Estimate) -> bool:
        """Move the point to an estimate of the nuisances and all else, where one is certain and far from it."""
        now, m = self.state, self._linear.size
        value, std = estimate.pi[:m], np.sqrt(np.diag(estimate.covariance)[:m])
        known = self._movable & estimate.determined[:m] & (np.abs(value) < self._largest)
        by = np.where(known, np.abs(value - now.point), 0.0)
        share = CONVERGED if now.point.any() else 1.0
        if not now.steps or not np.any((by > share * self._linear) & (by > share * CERTAIN * std)):
            return False
        now.steps -= 1
        now.point = np.where(known, value, now.point)
        return True
