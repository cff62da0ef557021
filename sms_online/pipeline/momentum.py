"""The momentum balance of a session, from grid samples to an estimate with error bars."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np

from sms_online.calibration.columns import CalibrationColumns, nuisances
from sms_online.calibration.nuisance import bound_rows, prior_rows
from sms_online.calibration.release import released
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.beforehand import Beforehand
from sms_online.pipeline.changes import Adoption, Changes
from sms_online.pipeline.criterion import RowGrams, ScaleFree
from sms_online.pipeline.description import nearer
from sms_online.pipeline.drift_line import DriftLine
from sms_online.pipeline.errors_in_variables import NoiseBias, unbiased
from sms_online.pipeline.latency import Latencies, clock_groups, source_groups, wandering_clocks
from sms_online.pipeline.linearisation import Linearisation
from sms_online.pipeline.momentum_balance import MomentumBalance, half_hop
from sms_online.pipeline.momentum_fit import FIRST_MOTION, MomentumFit, WhiteRows
from sms_online.pipeline.momentum_windows import COPIES, HOPS, INSTANTS
from sms_online.pipeline.residual_test import SequentialTest
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import NoiseEstimate, SensorNoise
from sms_online.pipeline.statistics import MomentumStatistics
from sms_online.pipeline.synchronise import GridSamples
from sms_online.pipeline.tracker_bank import Change, Reading, TrackerBank
from sms_online.pipeline.window_noise import WindowNoise
from sms_online.state import Stage, State, snapshot, state_copy
from sms_online.stream import Array
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Estimate, Prior, Rows, Tracker, prior_factor
from sms_online.trackers.square_root import session_tracker

# The synthetic noise is the same in every session, so that the same samples give the same bits.
SEED = 6
# Motion, s, in which a lack that was there from the start is noticed as a rule: that of the first fit, and a second.
TESTED = FIRST_MOTION + 1.0
# Variance of rows over the predicted one, at most, where noise is not white: its density at low frequencies follows
# from that at high ones.
COLOURED_NOISE = 2.0
# Frequency that a window lets pass best, times its length.
PASS_BAND = 2.0
# Mean square of rows over their predicted variance up to which nuisances of first order explain what they hold.
EXPLAINED = 1.5
# Time from one estimate of the sensors' noise to the next, s.
NOISE_RENEWED = 1.0


class MomentumState(State):
    """What a momentum balance keeps beside its stages.

    known (k, m + n + 1): what is known from before an event, as rows [N Y b] of unit variance. misfit (n_v,): behind
    the rows that came last. sensor_noise: as estimated at grid index `noise_at`. waiting: samples, until the noise is
    known. newest_row: time of the last window's end, s. start_time: of grid index 0, s. random: gives the synthetic
    noise. drift: known to windows to come.
    """

    known: Array
    misfit: Array
    random: np.random.Generator
    sensor_noise: SensorNoise | None = None
    noise_at: int = 0
    waiting: list[GridSamples] = msgspec.field(default_factory=list)
    segment: int = -1
    start_time: float = np.nan
    newest_row: float = -np.inf
    dropped_windows: int = 0
    drift: DriftLine | None = None


class Momentum(Stage):
    """Balance, weights and trackers of one session.

    tracker: fed with rows of unit variance, all of which count alike: weights follow from its estimate. bank: the
    trackers that the person has chosen, fed with the same. bias: what noise in the columns does to the estimate. grams:
    sums of rows by generalized speed, for an estimate where they leave more than noise. fit: what makes rows
    independent, and its sums. latencies: of the sources, since the last event. test: whether rows leave more than
    noise, likewise. changes: events, and the model and parameters that the session goes on with after them. nuisances:
    what the description may be wrong in. prior: what is known of the described ones beforehand. changed: called where
    others come to be estimated. linearisation: the nuisances that rows are linear about.
    """

    def __init__(self, model: Model, base: BaseParameters, sensing: Sensing, changed: Callable[[], None]) -> None:
        system = model.system
        self.sensing = sensing
        self.nuisances = nuisances(sensing)
        self._changed = changed
        self._sample_rate = system.sample_rate
        self._span = system.windows.momentum
        first = round(FIRST_MOTION * HOPS / self._span)
        self.linearisation = Linearisation(sensing, self.nuisances, self._sample_rate, first)
        self._described = model, base
        self.changes = self._new_changes()
        self._estimate = NoiseEstimate(sensing, system.sample_rate, PASS_BAND / self._span)
        self.prior: Prior | None = None
        self._sources, self._clocks = source_groups(sensing), clock_groups(sensing)
        self.bank = self._new_bank()
        self._build()
        self.bias, self.grams = self._new_sums()
        self.state = self._new_state()

    def _new_changes(self) -> Changes:
        model, base = self._described
        return Changes(model, base, self.sensing, self.nuisances, self._rebuild, self._point)

    def _point(self) -> Array:
        """Nuisances (m,) that samples are corrected by."""
        return self.linearisation.point

    def _new_state(self) -> MomentumState:
        model, base = self._described
        n = len(self.nuisances) + base.n
        return MomentumState(np.zeros((0, n + 1)), np.zeros(model.layout.n_v), np.random.default_rng(SEED))

    def _new_sums(self) -> tuple[NoiseBias, RowGrams]:
        n = len(self.nuisances) + self.changes.base.n
        return NoiseBias.none(n, self._calibration), RowGrams.none(self.changes.model.layout.n_v, n)

    @property
    def newest_row(self) -> float:
        """Time of the last window's end, s; -inf before the first."""
        return self.state.newest_row

    @property
    def sensor_noise(self) -> SensorNoise | None:
        """Noise of the sensors as estimated last, None while it is not known."""
        return self.state.sensor_noise

    def _build(self) -> None:
        """Empty stages for the current model and parameters, but for the trackers that were chosen."""
        model, base = self.changes.model, self.changes.base
        self._calibration = prior_rows(self.nuisances, base.n)
        self._balance = MomentumBalance(model, base, self._sample_rate, self._span, moments=self.bank.follows)
        self.latencies = Latencies(self._sources, base.n)
        self.fit = MomentumFit(
            model, base, self._balance, self._new_noise, self._solved, self._sources, self._calibration,
            self._beforehand, [k for k, each in enumerate(self.nuisances) if each.name == "drive_gain"], self._drift_at,
            self._point,
        )  # fmt: skip
        self.tracker = self._new_tracker()
        self.fit.plain.patient = self.bank.learned is not None
        self.test = self._new_test()

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

    def _new_tracker(self) -> Tracker:
        tracker = session_tracker(self.changes.base.n, self.current_prior, len(self.nuisances))
        if self.nuisances:
            tracker.begin(self.changes.beforehand)
        return tracker

    def _new_bank(self) -> TrackerBank:
        model, base, nuisances = self.changes.model, self.changes.base, self.nuisances
        prior, n_v = self.current_prior, model.layout.n_v
        steady = not self._clocks
        return TrackerBank(model.system, base.parameters, nuisances, prior, n_v, self._window, steady)

    @property
    def _window(self) -> float:
        """Length of a window, s."""
        return INSTANTS * half_hop(self._sample_rate, self._span) / self._sample_rate

    def _drift_at(self, end: int) -> DriftLine | None:
        """The known drift in the window that ends at a grid index."""
        drift = self.state.drift
        return None if drift is None else drift.at(self._centre(end))

    def _centre(self, end: int) -> float:
        """Centre of the window that ends at a grid index, s."""
        return self.state.start_time + end / self._sample_rate - 0.5 * self._window

    def set_prior(self, prior: Prior) -> None:
        """Add what is known of the base parameters beforehand as a prior; before the first sample."""
        self.prior = prior
        self.tracker, self.bank = self._new_tracker(), self._new_bank()

    @property
    def started(self) -> bool:
        """Whether weights are known and rows come."""
        return self.fit.weights is not None

    @property
    def testable(self) -> bool:
        """Whether there are rows enough since the last event for a test of what they leave."""
        return self.started and self.fit.plain.windows * self._balance.span / HOPS >= TESTED

    @property
    def misfit(self) -> bool:
        """Whether rows leave clearly more than the sensors' noise."""
        return bool(self.fit.plain.misfit.any())

    def estimate(self, t: float) -> Estimate:
        """The base parameters as known now, free of what noise in the columns does; with a prior, as the rows say.

        By the tracker that is chosen first. t: of the newest sample, s, for which parameters that drift hold.
        """
        own = self._own()
        return self.bank.judged(own, self.bias, t) if self.bank.others else own

    def readings(self, t: float) -> tuple[Reading, ...]:
        """Readings of each chosen tracker, the judged one first; empty where that is the session's own alone."""
        return self.bank.readings(self._own(), self.bias, t) if self.bank.others else ()

    def _own(self) -> Estimate:
        return self._joint().without_nuisances(len(self.nuisances))

    def _joint(self) -> Estimate:
        """The nuisances, then the base parameters."""
        estimate, scale_free = self.tracker.estimate(), self.scale_free
        if scale_free is not None:
            return scale_free.estimate(estimate)
        return released(unbiased(estimate, self.bias), self.nuisances, estimate.covariance)

    @property
    def scale_free(self) -> ScaleFree | None:
        """Where rows leave more than noise, what gives the estimate in place of least squares."""
        if not self.misfit or self.grams.windows == 0:
            return None
        assert self.fit.weights is not None
        weights = np.pad(self.fit.weights, (len(self.nuisances), 0))
        lacking = self.fit.plain.misfit > 0.0
        fit, known = self.fit, self._beforehand()
        return ScaleFree(state_copy(self.grams), lacking, fit.torque, weights, fit.columns, known, self.prior is None)

    def _beforehand(self) -> Beforehand:
        """What is known of nuisances and parameters beside the rows; tolerances may be released, within bounds."""
        m, prior = len(self.nuisances), self.current_prior
        known = np.pad(prior_factor(prior, self.changes.base.n), ((0, 0), (m, 0)))
        may = np.array([each.may_give_way for each in self.nuisances if np.isfinite(each.tolerance)], dtype=np.bool_)
        bounds = bound_rows(self.nuisances, self.changes.base.n)
        certain = np.concatenate((self.state.known, self._calibration[~may], bounds, known))
        return Beforehand(certain, self._calibration[may])

    def _solved(self) -> Array:
        """Nuisances and β, of the rows and, where these determine little, of the description."""
        return nearer(self._own(), *self.fit.described)

    def observe(self, t: Array, values: Array) -> None:
        """Take the channels' own samples (B, channels) at t (B,), NaN where there is none, to estimate their noise."""
        self._estimate.push(t, values)

    def push(self, piece: GridSamples, start_time: float, periods: Array) -> None:
        """Take grid samples of the channels, followed by internal states of effects.

        start_time: s of grid index 0. periods (channels,): sample periods, s.
        """
        self.state.start_time = start_time
        self.state.waiting.append(piece)
        due = self.state.noise_at + round(NOISE_RENEWED * self._sample_rate)
        if (self.state.sensor_noise is None or piece.index[-1] >= due) and self._estimate.ready:
            self.state.sensor_noise = self._estimate.noise(periods)
            self.state.noise_at = int(piece.index[-1])
        if self.state.sensor_noise is None:
            return
        waiting, self.state.waiting = self.state.waiting, []
        for each in waiting:
            for corrected in self.linearisation.push(each):
                self._advance(corrected, self.state.sensor_noise)
            self._relinearise(self.state.sensor_noise, last=False)

    def _relinearise(self, noise: SensorNoise, last: bool) -> None:
        """Now and then, where the estimate is far from the point that rows are linear about: go there."""
        if self.changes.events:
            self.linearisation.forget()
        if not self.started or not self.linearisation.looks(self.fit.plain.windows, last):
            return
        # Where rows hold more than noise and errors of calibration, these look like what the model lacks.
        if self._row_variance > EXPLAINED:
            return
        before, weights = self.linearisation.point, self._weights()
        while self.linearisation.moves(self._joint()):
            self._make_rows_again(self._weights(), noise, last)
            if self._row_variance > EXPLAINED:
                self.linearisation.go_back(before)
                self._make_rows_again(weights, noise, last)
                self.linearisation.forget()
                return
            before, weights = self.linearisation.point, self._weights()

    @property
    def _row_variance(self) -> float:
        """Mean square of what the rows leave, in units of their predicted variance."""
        estimate = self._joint()
        return estimate.rss / max(estimate.dof, 1.0) * (1.0 + float(self.fit.plain.misfit.mean()))

    def _weights(self) -> Array:
        """β (n,) that rows are weighted with."""
        return self._solved()[len(self.nuisances) :]

    def _make_rows_again(self, weights: Array, noise: SensorNoise, last: bool) -> None:
        """All rows of the session so far, about the point of now."""
        self._begin_anew(weights, noise)
        for piece in self.linearisation.again():
            self._advance(piece, noise)
        if last:
            self._end_segment(noise)

    def _begin_anew(self, weights: Array, noise: SensorNoise) -> None:
        """Forget all rows, and begin with weights β (n,) that are known."""
        before = self.state
        self.changes, self.bank, self.state = self._new_changes(), self._new_bank(), self._new_state()
        self.state.sensor_noise, self.state.noise_at = before.sensor_noise, before.noise_at
        self.state.start_time = before.start_time
        self.bias, self.grams = self._new_sums()
        self._build()
        self.fit.go_on(weights, noise)

    def _advance(self, piece: GridSamples, noise: SensorNoise) -> None:
        if piece.segment != self.state.segment:
            if self.state.segment >= 0:
                self._end_segment(noise)
            self._balance.begin_segment()
            self.state.segment = piece.segment
        self.changes.keep(piece)
        self.bank.hold_until(self.state.start_time + int(piece.index[-1]) / self._sample_rate)
        self._process(piece, noise)
        self._decide(noise, last=False)

    def _end_segment(self, noise: SensorNoise) -> None:
        self._absorb(self.fit.end_segment(noise))
        self._decide(noise, last=True)

    def _process(self, piece: GridSamples, noise: SensorNoise) -> None:
        copies = self._copies(piece.values, noise)
        windows, instants = self._balance.push(piece.index, copies, noise.coordinates)
        self._absorb(self.fit.push(windows, instants, noise))

    def _decide(self, noise: SensorNoise, last: bool) -> None:
        """Where rows are held back for an event: decide on it, once there are enough of them, and go on."""
        if not last and self._drift_decided(noise):
            return
        adoption = self.changes.decide(noise, self.state.start_time, last)
        if adoption is not None:
            self._adopt(adoption, noise)

    def adopt(self, adoption: Adoption) -> None:
        """Go on with effects that the model lacked, see `Changes.adopt`; rows are there already."""
        assert self.state.sensor_noise is not None
        for samples in self.linearisation.corrected(adoption.samples):
            adoption = replace(adoption, samples=samples)
        self._adopt(adoption, self.state.sensor_noise)

    def _adopt(self, adoption: Adoption, noise: SensorNoise) -> None:
        """Go on after an event with what is known from before it."""
        n, n_v = len(self.nuisances) + adoption.base.n, adoption.model.layout.n_v
        self.bias.widen(n - self.bias.parameters)
        self.grams, self.state.misfit = RowGrams.none(n_v, n), np.zeros(n_v)
        self.state.known, self.state.drift = adoption.known.factor, None
        self._rebuild()
        self.tracker.begin(adoption.known)
        self.bank.begin(adoption.known)
        self.fit.go_on(adoption.weights, noise)
        if adoption.samples.index.size:
            self._process(adoption.samples, noise)

    def _copies(self, values: Array, noise: SensorNoise) -> list[Array]:
        """Coordinates and joint torques as measured, and with synthetic noise added and subtracted."""
        measured = self.sensing.motion(values)
        if noise.exact:
            return [measured] * COPIES
        added = np.zeros_like(values)
        columns = [*self.sensing.position_columns, *self.sensing.torque_columns]
        added[:, columns] = self.state.random.standard_normal((values.shape[0], len(columns))) * noise.grid
        return [measured, self.sensing.motion(values + added), self.sensing.motion(values - added)]

    def finish(self, periods: Array) -> None:
        """End of the session: fit what is still held back."""
        if self.state.sensor_noise is None and self.state.waiting and self._estimate.ready:
            self.state.sensor_noise = self._estimate.noise(periods)
        if self.state.sensor_noise is not None:
            self._end_segment(self.state.sensor_noise)
            self._relinearise(self.state.sensor_noise, last=True)
            adoption = self.changes.abandon(self.state.start_time)
            if adoption is not None:
                self._adopt(adoption, self.state.sensor_noise)

    def _absorb(self, fresh: list[WhiteRows]) -> None:
        for rows in fresh:
            if not np.isfinite(rows.Y).all():
                self.state.dropped_windows += 1
                continue
            detector = self.changes.detector
            noise = self.state.sensor_noise
            if noise is not None and not noise.exact:
                self.test.push(rows, detector.known.factor, COLOURED_NOISE if noise.coloured else 1.0)
            if not detector.push(rows, self.misfit):
                onset = self.state.start_time + detector.onset / self._sample_rate - self._window
                self.bank.hold(self._for_trackers(rows), onset)
                continue
            t = self.state.start_time + rows.end / self._sample_rate
            M = rows.Y.shape[0]
            self.tracker.update(Rows(rows.Y[:, :-1], rows.Y[:, -1], np.ones(M), np.full(M, t)))
            self._follow(rows)
            self.state.newest_row = t
            self.bias.add(rows.Y, rows.noisy)
            if np.any(rows.misfit != self.state.misfit):
                # Rows that were whitened as if the model lacked less must not outweigh those to come.
                self.grams.weaken(np.minimum(1.0, (1.0 + self.state.misfit) / (1.0 + rows.misfit)))
                self.state.misfit = rows.misfit
            self.grams.add(rows.Y, rows.noisy)
            self.latencies.add(rows.Y[:, len(self.nuisances) :], rows.late)
        if self.bank.follows and fresh:
            self._renew_drift()

    def _follow(self, rows: WhiteRows) -> None:
        """Hand rows to the chosen trackers, and to what watches for drifts."""
        learned = self.bank.learned
        before = 0 if learned is None else learned.state.accepted
        self.bank.update(self._for_trackers(rows), not self.misfit)
        if learned is not None:
            self.fit.plain.patient = learned.patient
            if learned.state.accepted > before:
                self._begin_drift(learned.information)

    def _for_trackers(self, rows: WhiteRows) -> Rows:
        """Rows with the drift that was subtracted from them."""
        m, centre, b, ramp = len(self.nuisances), self._centre(rows.end), rows.Y[:, -1], None
        if self.bank.follows:
            ramp = np.pad(rows.ramp, ((0, 0), (m, 0)))
        if rows.drift is not None:
            b = b + rows.Y[:, m:-1] @ rows.drift.moved + rows.ramp @ rows.drift.rate
        return Rows(rows.Y[:, :-1], b, np.ones(b.size), np.full(b.size, centre), ramp)

    def _drift_decided(self, noise: SensorNoise) -> bool:
        """Whether rows held back need no event decided on: not yet, or they were those of a drift."""
        detector, learned = self.changes.detector, self.bank.learned
        if detector.alarm is None or learned is None:
            return False
        onset, alarm, newest = (
            self.state.start_time + end / self._sample_rate
            for end in (detector.onset, detector.alarm, detector.history[-1].end)
        )
        change = Change(onset - self._window, alarm, newest)
        drift = self.bank.drift_behind(change)
        if isinstance(drift, bool):
            return drift
        samples, before = self.changes.behind(detector.alarm), state_copy(learned.state)
        self.bank.go_on_behind(change, drift, held=True)
        known = learned.information
        self._build()
        self._begin_drift(known)
        self._renew_drift()
        # Rows come again as behind an event, whitened among themselves: those held back hold parameters of before.
        learned.state = before
        self.bank.go_on_behind(change, drift, held=False)
        self.bank.release()
        self.fit.go_on(known.solution().pi[len(self.nuisances) :], noise)
        self._process(samples, noise)
        return True

    def _renew_drift(self) -> None:
        """Have windows to come know of the drift so far; not those whose rows are made already."""
        centre, m = self.state.newest_row - 0.5 * self._window, len(self.nuisances)
        line = self.bank.drift(self.tracker.estimate, centre, self.state.drift)
        if line is None or line is self.state.drift:
            return
        # What takes parameters for constant goes on from what the judged tracker knows of them, less the drift.
        self.state.drift = line
        moved = np.concatenate((np.zeros(m), line.moved))
        known = self.bank.information.shifted(-moved)
        self.tracker.begin(known)
        self.changes.detector.follow(known, moved)

    def _begin_drift(self, known: Information) -> None:
        """Have what has judged rows by constant parameters begin anew."""
        m = len(self.nuisances)
        self.changes.detector.begin(known)
        self.bias, self.grams = self._new_sums()
        self.fit.plain.clear()
        self.test = self._new_test()
        self.bank.refer(known.solution().pi[m:])
        self.state.known, self.state.drift = known.factor, None

    @property
    def drifts(self) -> int:
        """How often the judged tracker has found one to begin or to change, since the last event."""
        return 0 if self.bank.learned is None else self.bank.learned.state.accepted

    @property
    def drifting(self) -> tuple[str, ...]:
        """Parameters that the judged tracker has found to drift."""
        learned, m = self.bank.learned, len(self.nuisances)
        columns = [] if learned is None else learned.columns
        return tuple(self.changes.base.parameters[column - m].name for column in columns)

    @property
    def _reference(self) -> Array | None:
        """Nuisances and parameters that the rows without the known drift have; None where nothing has moved."""
        return None if self.state.drift is None else self._joint().pi

    def statistics(self, t: float) -> MomentumStatistics:
        """What is known now; nothing in it changes as the session goes on. t: of the newest sample, s."""
        alarm, noise = self.test.alarm, self.state.sensor_noise
        return MomentumStatistics(
            trackers=self.readings(t),
            reference=self._reference,
            tracker=snapshot(self.tracker),
            bias=state_copy(self.bias),
            rows=state_copy(self.fit.plain),
            started=self.started,
            tested=self.testable,
            alarm=None if alarm is None else alarm.row,
            scale_free=self.scale_free,
            latency=self.latencies.found,
            coloured={} if noise is None else noise.coloured,
            # Rounding moves as it likes where samples are exact.
            suspected=None if noise is None or noise.exact else self.bank.suspected,
            shifts=tuple(self.changes.shifts),
            unwatched=self.bank.unwatched,
            point=self.linearisation.point,
        )
