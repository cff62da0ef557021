"""The momentum balance about a point of the nuisances that follows what samples show, see `linearisation`.

Samples wait until the noise of the sensors is known, are corrected by the point, and go to the balance. Where its
estimate of the nuisances is far from the point, that moves, and a new balance gets all samples so far once more. So it
does where rows turn out to lack more than a drift that was yet to be learned: their weights took it for one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import msgspec

from sms_online.calibration.columns import nuisances
from sms_online.description.schema import TrackerChoice
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.changes import ModelUpdate
from sms_online.pipeline.linearisation import Linearisation
from sms_online.pipeline.momentum import Momentum
from sms_online.pipeline.momentum_fit import FIRST_MOTION
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import NoiseEstimate, SensorNoise
from sms_online.pipeline.synchronise import GridSamples
from sms_online.state import Stage, State
from sms_online.stream import Array
from sms_online.trackers.interface import Prior

# Frequency that a window lets pass best, times its length.
PASS_BAND = 2.0
# Time from one estimate of the sensors' noise to the next, s.
NOISE_RENEWED = 1.0
# Mean square of rows over their predicted variance up to which nuisances of first order explain what they hold.
EXPLAINED = 1.5


class RelinearisationState(State):
    """What comes before the balance.

    noise: of the sensors, as estimated at grid index `noise_at`; made_with: that of the first rows. waiting: samples,
    until it is known. start_time: of grid index 0, s. patient: see `MomentumState`.
    """

    noise: SensorNoise | None = None
    made_with: SensorNoise | None = None
    noise_at: int = 0
    waiting: list[GridSamples] = msgspec.field(default_factory=list)
    start_time: float = float("nan")
    patient: bool = True


class Relinearisation(Stage):
    """Hands corrected samples to a momentum balance, and begins another one where the correction changes.

    momentum: the balance of now. trackers: of the session, see `session_trackers`. changed: called where other
    parameters come to be estimated.
    """

    def __init__(
        self,
        model: Model,
        base: BaseParameters,
        sensing: Sensing,
        trackers: Sequence[TrackerChoice],
        changed: Callable[[], None],
    ) -> None:
        system = model.system
        self._trackers = tuple(trackers)
        self._described, self._sensing, self._changed = (model, base), sensing, changed
        self._nuisances = nuisances(sensing)
        self._prior: Prior | None = None
        span = system.windows.momentum
        self._estimate = NoiseEstimate(sensing, system.sample_rate, PASS_BAND / span)
        self._renewed = round(NOISE_RENEWED * system.sample_rate)
        first = round(FIRST_MOTION * HOPS / span)
        learns = trackers[0].learns
        self.linearisation = Linearisation(sensing, self._nuisances, system.sample_rate, first, learns)
        self.state = RelinearisationState()
        self.momentum = self._new_momentum()

    def _new_momentum(self) -> Momentum:
        return Momentum(
            *self._described, self._sensing, self._nuisances, self._prior, self._trackers, self._point, self._changed,
            self.state.patient,
        )  # fmt: skip

    def _point(self) -> Array:
        """Nuisances (m,) that samples are corrected by."""
        return self.linearisation.point

    def set_prior(self, prior: Prior) -> None:
        """Add what is known of the base parameters beforehand as a prior; before the first sample."""
        self._prior = prior
        self.momentum = self._new_momentum()

    def observe(self, t: Array, values: Array) -> None:
        """Take the channels' own samples (B, channels) at t (B,), NaN where there is none, to estimate their noise."""
        self._estimate.push(t, values)

    def push(self, piece: GridSamples, start_time: float, periods: Array) -> None:
        """Take grid samples of the channels, followed by internal states of effects.

        start_time: s of grid index 0. periods (channels,): sample periods, s.
        """
        now = self.state
        now.start_time = start_time
        now.waiting.append(piece)
        if (now.noise is None or piece.index[-1] >= now.noise_at + self._renewed) and self._estimate.ready:
            now.noise, now.noise_at = self._noise(periods), int(piece.index[-1])
            now.made_with = now.made_with or now.noise
            if now.noise.outdates(now.made_with) and self.linearisation.state.samples:
                # The first samples do not show how slow their noise is, or that it moves.
                now.made_with = now.noise
                self._make_rows_again(self.momentum.weights if self.momentum.started else None, now.noise)
        if now.noise is None:
            return
        waiting, now.waiting = now.waiting, []
        for each in waiting:
            self._advance((corrected, now.noise) for corrected in self.linearisation.push(each, now.noise))
            self._look(now.noise, last=False)

    def finish(self, periods: Array) -> None:
        """End of the session: fit what is still held back."""
        now = self.state
        if now.noise is None and now.waiting and self._estimate.ready:
            now.noise = self._noise(periods)
        if now.noise is not None:
            self.momentum.end_segment(now.noise)
            self._look(now.noise, last=True)
            self.momentum.finish(now.noise)

    def _noise(self, periods: Array) -> SensorNoise:
        return self._estimate.noise(periods, self.momentum.changes.model.system)

    def adopt(self, update: ModelUpdate, samples: GridSamples, periods: Array | None) -> None:
        """Go on with effects that the model lacked; rows are there already.

        samples: that hold them, as prepared, not yet corrected by the point. periods (channels,): sample periods, s,
        where samples are prepared in another way than before, with other noise.
        """
        corrected = self.linearisation.begin(samples)
        adoption = self.momentum.changes.adopt(update, corrected)
        if periods is not None:
            self.state.noise = self._noise(periods)
        assert self.state.noise is not None
        self.momentum.adopt(adoption, self.state.noise)

    def _advance(self, corrected: Iterable[tuple[GridSamples, SensorNoise]]) -> None:
        for piece, noise in corrected:
            self.momentum.push(piece, noise, self.state.start_time)

    def _look(self, noise: SensorNoise, last: bool) -> None:
        """Now and then, where the estimate is far from the point that rows are linear about: go there."""
        if self._has_changed:
            self.linearisation.forget()
        if self.momentum.lacking(last) and self.linearisation.state.samples:
            self.state.patient = False
            self._make_rows_again(None, None, last)
        if not self.momentum.started or not self.linearisation.looks(self.momentum.fit.plain.windows, last):
            return
        if self._lacks:
            return
        before, weights = self.linearisation.point, self.momentum.weights
        while self.linearisation.moves(self.momentum.joint_estimate):
            self._make_rows_again(self.momentum.weights, noise, last)
            if self._lacks:
                self.linearisation.go_back(before)
                self._make_rows_again(weights, noise, last)
                self.linearisation.forget()
                return
            if self._has_changed:
                # Rows about this point show an event, and parameters that it adds are none of those before it.
                self.linearisation.forget()
                return
            before, weights = self.linearisation.point, self.momentum.weights

    @property
    def _has_changed(self) -> bool:
        """Whether something has changed: no one point is that of the samples before and after."""
        return bool(self.momentum.changes.events or self.momentum.changes.shifts)

    @property
    def _lacks(self) -> bool:
        """Whether rows hold more than noise and errors of calibration: these look like what the model lacks there."""
        return self.momentum.joint.row_variance(self.momentum.fit) > EXPLAINED

    def _make_rows_again(self, weights: Array | None, noise: SensorNoise | None, last: bool = False) -> None:
        """All rows of the session so far, about the point of now.

        weights: β (n,), None to find them anew. noise: of the sensors; None for what was known of it when samples came.
        """
        self.momentum = self._new_momentum()
        if weights is not None and noise is not None:
            self.momentum.fit.go_on(weights, noise, self.momentum.fit.plain.misfit)
        self._advance((piece, noise or then) for piece, then in self.linearisation.again())
        if last and self.state.noise is not None:
            self.momentum.end_segment(self.state.noise)
