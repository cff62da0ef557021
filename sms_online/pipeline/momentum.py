"""The momentum balance of a session, from corrected grid samples to an estimate with error bars."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from sms_online.calibration.channels import multiplying
from sms_online.calibration.columns import CalibrationColumns
from sms_online.calibration.nuisance import Nuisance, prior_rows
from sms_online.description.schema import TrackerChoice
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.changes import Adoption, Changes
from sms_online.pipeline.description import nearer
from sms_online.pipeline.drift_line import DriftLine
from sms_online.pipeline.event_rows import AfterChange
from sms_online.pipeline.joint_estimate import JointEstimate
from sms_online.pipeline.latency import Latencies, clock_groups, source_groups, wandering_clocks
from sms_online.pipeline.momentum_balance import MomentumBalance, half_hop
from sms_online.pipeline.momentum_fit import FIRST_MOTION, MomentumFit
from sms_online.pipeline.momentum_windows import HOPS, INSTANTS
from sms_online.pipeline.noisy_copies import NoisyCopies
from sms_online.pipeline.residual_test import SequentialTest
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.pipeline.synchronise import GridSamples
from sms_online.pipeline.torque_gains import gain_columns
from sms_online.pipeline.tracker_bank import Change, Reading, TrackerBank
from sms_online.pipeline.white_rows import WhiteRows
from sms_online.pipeline.window_noise import WindowNoise
from sms_online.state import Stage, State, state_copy
from sms_online.stream import Array
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Estimate, Prior, Rows

# Motion, s, in which a lack that was there from the start is noticed as a rule: that of the first fit, and a second.
TESTED = FIRST_MOTION + 1.0
# Variance of rows over the predicted one, at most, where noise is not white: its density at low frequencies follows
# from that at high ones.
COLOURED_NOISE = 2.0


class MomentumState(State):
    """What a momentum balance keeps beside its stages.

    sensor_noise: that of the samples so far. newest_row: time of the last window's end, s. start_time: of grid index 0,
    s. patient: whether more than noise in the beginning may be a drift yet to be learned. prior_within: what is handed
    on from a drift holds the prior; bank_within: trackers went on from such. drift: known to windows to come. held:
    rows since an alarm that may be false.
    """

    patient: bool
    prior_within: bool = False
    bank_within: bool = False
    sensor_noise: SensorNoise | None = None
    segment: int = -1
    start_time: float = np.nan
    newest_row: float = -np.inf
    dropped_windows: int = 0
    drift: DriftLine | None = None
    held: list[WhiteRows] = msgspec.field(default_factory=list)


class Momentum(Stage):
    """Balance, weights and trackers of a session's samples that are corrected by one point, see `Relinearisation`.

    joint: sums of rows of unit variance, which weights follow. bank: the trackers that the person has chosen, fed with
    the same. fit: what makes rows independent, and its sums. latencies: of the sources, since the last event. test:
    whether rows leave more than noise, likewise. changes: events, and the model and parameters that the session goes on
    with after them. nuisances: what the description may be wrong in. prior: of the described parameters. point: gives
    the nuisances (m,) that samples are corrected by. changed: called where other parameters come to be estimated.
    patient: see `MomentumState`.
    """

    def __init__(
        self,
        model: Model,
        base: BaseParameters,
        sensing: Sensing,
        nuisances: Sequence[Nuisance],
        prior: Prior | None,
        trackers: Sequence[TrackerChoice],
        point: Callable[[], Array],
        changed: Callable[[], None],
        patient: bool,
    ) -> None:
        system = model.system
        self.sensing, self.nuisances, self.prior, self._trackers = sensing, tuple(nuisances), prior, tuple(trackers)
        self.point, self._changed = point, changed
        self._sample_rate, self._span = system.sample_rate, system.windows.momentum
        self.changes = Changes(
            model, base, sensing, self.nuisances, self._rebuild, point, self._beside_squares, trackers[0],
            self._drift_since,
        )  # fmt: skip
        self._sources, self._clocks = source_groups(sensing), clock_groups(sensing)
        self.state = MomentumState(patient)
        self.copies = NoisyCopies(sensing, system.sample_rate)
        self.bank = self._new_bank()
        self._build()

    @property
    def sensor_noise(self) -> SensorNoise | None:
        """Noise of the sensors as estimated last, None while it is not known."""
        return self.state.sensor_noise

    def _build(self) -> None:
        """Empty stages for the current model and parameters, but for the trackers that were chosen."""
        model, base = self.changes.model, self.changes.base
        multiply = multiplying(self.sensing)
        self.joint = JointEstimate(model, base, self.nuisances, multiply, self.current_prior, self.state.prior_within)
        self._balance = MomentumBalance(model, base, self._sample_rate, self._span, moments=self.bank.follows)
        self.latencies = Latencies(self._sources, base.n)
        self.fit = MomentumFit(
            model, base, self._balance, self._new_noise, self._solved, prior_rows(self.nuisances, base.n), self.point,
            self._sources, self.joint.prior_information, gain_columns(model, base, self.nuisances), self._drift_at,
        )  # fmt: skip
        self.fit.plain.patient = self.state.patient and self.bank.patient
        self.test = self._new_test()

    def renew(self) -> None:
        """See Stage."""
        if self.state.prior_within:
            self.bank = self._new_bank()
            self._build()

    def _rebuild(self) -> None:
        """The same after an event, trackers included."""
        self.bank = self._new_bank()
        self._build()
        self._changed()

    @property
    def current_prior(self) -> Prior | None:
        """What is known beforehand of the current parameters."""
        return None if self.prior is None else self.changes.prior(self.prior)

    def _new_noise(self) -> WindowNoise:
        model, balance, sensing = self.changes.model, self._balance, self.sensing
        calibration = CalibrationColumns(model, sensing, balance.span) if self.nuisances else None
        return WindowNoise(model, self.changes.base, balance, sensing.displacements, self._clocks, calibration)

    def _new_test(self) -> SequentialTest:
        clocks = wandering_clocks(self.sensing, self.nuisances)
        return SequentialTest(self.changes.model.layout, self._balance.span / HOPS, self.nuisances, clocks)

    def _new_bank(self) -> TrackerBank:
        model, parameters = self.changes.model, self.changes.base.parameters
        prior, within, n_v = self.current_prior, self.state.bank_within, model.layout.n_v
        return TrackerBank(
            self._trackers, model.system.name, parameters, self.nuisances, prior, within, n_v, self._window,
            steady=not self._clocks,
        )  # fmt: skip

    @property
    def _window(self) -> float:
        """Length of a window, s."""
        return INSTANTS * half_hop(self._sample_rate, self._span) / self._sample_rate

    def _drift_at(self, end: int) -> DriftLine | None:
        """The known drift in the window that ends at a grid index."""
        drift = self.state.drift
        return None if drift is None else drift.at(self._centre(end))

    def _drift_since(self, end: int) -> DriftLine | None:
        """The same, counted from when what is known of the parameters is of."""
        return None if self.state.drift is None else self.state.drift.from_now().at(self._centre(end))

    def _centre(self, end: int) -> float:
        """Centre of the window that ends at a grid index, s."""
        return self.state.start_time + end / self._sample_rate - 0.5 * self._window

    @property
    def started(self) -> bool:
        """Whether weights are known and rows come."""
        return self.fit.weights is not None

    @property
    def testable(self) -> bool:
        """Whether there are rows enough since the last event for a test of what they leave."""
        return self.started and self.fit.plain.windows * self._balance.span / HOPS >= TESTED

    def lacking(self, last: bool) -> bool:
        """Whether rows leave more than noise while that was taken for a drift, and none of ramps explains it.

        last: the session ends, and a drift that was not learned so far is none.
        """
        if not self.state.patient or self.bank.learned is None or not self.started:
            return False
        unlearned = last and self.fit.plain.patient and not self.bank.accepted
        return self.bank.learned.state.lacking or (unlearned and bool(self.fit.plain.excess(self._solved()).any()))

    @property
    def misfit(self) -> bool:
        """Whether rows leave clearly more than the sensors' noise."""
        return bool(self.fit.plain.misfit.any())

    def estimate(self, t: float) -> Estimate:
        """The base parameters as known now, free of what noise in the columns does; with a prior, as the rows say.

        By the tracker that is chosen first. t: of the newest sample, s, for which parameters that drift hold.
        """
        own = self.joint_estimate.without_nuisances(len(self.nuisances))
        return self.bank.judged(own, self.joint.bias, t) if self.bank.others else own

    def readings(self, t: float) -> tuple[Reading, ...]:
        """Readings of each chosen tracker, the judged one first; empty where that is the session's own alone."""
        if not self.bank.others:
            return ()
        own = self.joint_estimate.without_nuisances(len(self.nuisances))
        return self.bank.readings(own, self.joint.bias, t)

    @property
    def joint_estimate(self) -> Estimate:
        """The nuisances, then the base parameters, by the session's own least squares."""
        return self.joint.estimate(self.fit)

    def _beside_squares(self) -> Array:
        return self.joint.solved(self.fit).pi - self.joint.tracker.estimate().pi

    @property
    def weights(self) -> Array:
        """β (n,) to weight rows with."""
        return self._solved()[len(self.nuisances) :]

    def _solved(self) -> Array:
        """Nuisances and β, of the rows and, where these determine little, of the description."""
        solved = self.joint.solved(self.fit, lost_unknown=True).without_nuisances(len(self.nuisances))
        return nearer(solved, *self.fit.described)

    def push(self, piece: GridSamples, noise: SensorNoise, start_time: float) -> None:
        """Take corrected grid samples of the channels, followed by internal states of effects.

        start_time: s of grid index 0.
        """
        self.state.sensor_noise, self.state.start_time = noise, start_time
        if piece.segment != self.state.segment:
            if self.state.segment >= 0:
                self.end_segment(noise)
            self._balance.begin_segment()
            self.state.segment = piece.segment
            self.copies.begin_segment()
        self.changes.keep(piece)
        self.bank.hold_until(self.state.start_time + int(piece.index[-1]) / self._sample_rate)
        self._process(piece, noise)
        self._decide(noise, last=False)

    def end_segment(self, noise: SensorNoise) -> None:
        """No more samples of this segment come: fit what is still held back."""
        self.state.sensor_noise = noise
        self._absorb(self.fit.end_segment(noise))
        self._decide(noise, last=True)

    def _process(self, piece: GridSamples, noise: SensorNoise) -> None:
        copies = self.copies.of(piece.values, noise)
        windows, instants = self._balance.push(piece.index, copies, noise.coordinates, noise.lateness)
        self._absorb(self.fit.push(windows, instants, noise))

    def _decide(self, noise: SensorNoise, last: bool) -> None:
        """Where rows are held back for an event: decide on it, once there are enough of them, and go on."""
        may_drift = self._may_drift
        found = self.changes.decide(noise, self.state.start_time, last, steps=may_drift)
        if may_drift and isinstance(found, AfterChange):
            self._decide_on_drift(found, noise, last)
            if self.bank.state.none:
                found = self.changes.decide(noise, self.state.start_time, last)
        if isinstance(found, Adoption):
            self.adopt(found, noise)
            if last:
                # The samples behind the event are the last of their segment.
                self._absorb(self.fit.end_segment(noise))
        self._take_back()

    def _take_back(self) -> None:
        """Take in rows that were held back for no event."""
        if self.changes.detector.alarm is None and self.state.held:
            held, self.state.held = self.state.held, []
            self.bank.release()
            for rows in held:
                self.changes.detector.push(rows, self.misfit)
                self._take_in(rows)

    def adopt(self, adoption: Adoption, noise: SensorNoise) -> None:
        """Go on after an event with what is known from before it."""
        bias, self.state.drift, self.state.held = self.joint.bias, None, []
        self.state.bank_within = self.state.prior_within
        self._rebuild()
        self.joint.begin_behind_event(adoption.known, bias)
        self.bank.begin(adoption.known)
        self.fit.go_on(adoption.weights, noise, adoption.misfit)
        if adoption.samples.index.size:
            self.state.segment = adoption.samples.segment
            self._process(adoption.samples, noise)

    def finish(self, noise: SensorNoise) -> None:
        """The session ends: what rows held back for an event hold is not known."""
        adoption = self.changes.abandon(self.state.start_time)
        if adoption is not None:
            self.adopt(adoption, noise)
        self._take_back()

    def _absorb(self, fresh: list[WhiteRows]) -> None:
        for rows in fresh:
            if not np.isfinite(rows.Y).all():
                self.state.dropped_windows += 1
                continue
            detector, noise = self.changes.detector, self.state.sensor_noise
            if noise is not None and not noise.exact:
                self.test.push(rows, detector.known.factor, COLOURED_NOISE if noise.coloured else 1.0)
            if not detector.push(rows, self.misfit):
                onset = self.state.start_time + detector.onset / self._sample_rate - self._window
                self.bank.hold(onset)
                if detector.uncertain:
                    self.state.held = [*self.state.held, rows]
                continue
            self._take_in(rows)
        if self.bank.follows and fresh:
            self._renew_drift()

    def _take_in(self, rows: WhiteRows) -> None:
        t = self.state.start_time + rows.end / self._sample_rate
        self._follow(rows)
        self.joint.add(rows, t)
        self.state.newest_row = t
        self.latencies.add(rows.Y[:, len(self.nuisances) :], rows.late)

    def _follow(self, rows: WhiteRows) -> None:
        """Hand rows to the chosen trackers, and to what watches for drifts."""
        before, noise = self.bank.accepted, self.state.sensor_noise
        # Rounding moves as it likes where samples are exact, and least squares where a torque's gain is a parameter.
        quiet = not self.fit.lacking.any() and noise is not None and not noise.exact
        self.bank.update(self._followed(rows), quiet, rows.moves)
        self.fit.plain.patient = self.state.patient and self.bank.patient
        if self.bank.accepted > before:
            self._begin_drift(self.bank.information)

    def _followed(self, rows: WhiteRows) -> Rows:
        return self.bank.rows(rows, self._centre(rows.end))

    @property
    def _may_drift(self) -> bool:
        """Whether rows are held back that may be those of a drift; where rows leave more than noise none is learned."""
        detector, none = self.changes.detector, self.bank.learned is None or self.bank.state.none
        return detector.alarm is not None and not (detector.uncertain or none)

    def _decide_on_drift(self, behind: AfterChange, noise: SensorNoise, last: bool) -> None:
        """Where rows held back are those of a drift: go on with it."""
        detector, learned = self.changes.detector, self.bank.learned
        assert detector.alarm is not None
        assert learned is not None
        start, rate, last_seen = self.state.start_time, self._sample_rate, detector.history[-1].end
        onset, alarm, newest = (start + end / rate for end in (detector.onset, detector.alarm, last_seen))
        change, rows = Change(onset - self._window, alarm, newest), [self._followed(each) for each in behind.rows]
        drift = self.bank.decide_on_drift(change, rows, behind.explanation.explained and behind.goes_on, last)
        if drift is None:
            return
        samples, before = self.changes.behind(detector.alarm), state_copy(learned.state)
        self.bank.go_on_behind(change, drift, rows)
        known = learned.information
        self._build()
        self._begin_drift(known)
        self._renew_drift()
        # Rows come again, free of the drift as it is known now, to what knows nothing of them.
        learned.state = before
        self.bank.go_on_behind(change, drift)
        self.bank.release()
        self._follow_line()
        self.fit.go_on(known.solution().pi[len(self.nuisances) :], noise, self.fit.plain.misfit)
        self._process(samples, noise)

    def _renew_drift(self) -> None:
        """Have windows to come know of the drift so far; not those whose rows are made already."""
        centre = self.state.newest_row - 0.5 * self._window
        line = self.bank.drift(self.joint.tracker.estimate, centre, self.state.drift)
        if line is None or line is self.state.drift:
            return
        self.state.drift = line
        self._follow_line()

    def _follow_line(self) -> None:
        """Have what takes parameters for constant go on from what the judged tracker knows of them, less the drift."""
        moved = np.zeros(self.changes.base.n) if self.state.drift is None else self.state.drift.moved
        moved = np.pad(moved, (len(self.nuisances), 0))
        known = self.bank.information.shifted(-moved)
        self.joint.tracker.begin(known)
        self.changes.detector.follow(known, moved)

    def _begin_drift(self, known: Information) -> None:
        """Have what has judged rows by constant parameters begin anew."""
        self.state.prior_within = True
        self.changes.follow_drift(known)
        self.joint.begin_drift(known)
        self.fit.plain.clear()
        self.test = self._new_test()
        self.bank.refer(known.solution().pi[len(self.nuisances) :])
        self.state.drift = None

    @property
    def reference(self) -> Array | None:
        """Nuisances and parameters that the rows without the known drift have; None where nothing has moved."""
        return None if self.state.drift is None else self.joint.solved(self.fit).pi
