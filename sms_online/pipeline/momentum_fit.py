"""Weights of the momentum balance: from windows of rows to rows with independent unit errors.

Weights follow from the sensors' noise and the parameters. Weights from residuals would collapse where noise is high.

The parameters come from the fit itself. The first windows that move are held back and fitted, see `first_weights`;
later the weights follow the estimate.

Where rows leave clearly more than noise, the excess counts as an error of each row's own. Whitening would otherwise
subtract neighbouring rows from each other, which share nearly all of their noise but not what the model lacks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.criterion import Columns
from sms_online.pipeline.description import described, near_rows
from sms_online.pipeline.drift_line import DriftLine
from sms_online.pipeline.first_weights import FirstWeights
from sms_online.pipeline.latency import SourceGroup
from sms_online.pipeline.momentum_balance import MomentumBalance
from sms_online.pipeline.momentum_windows import (
    COPIES,
    HOPS,
    INSTANTS,
    Instants,
    Window,
)
from sms_online.pipeline.plain_rows import PlainRows
from sms_online.pipeline.prior_information import PriorInformation, fitted
from sms_online.pipeline.second_order import RowErrors, beyond_first_order, size
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.pipeline.torque_gains import gained
from sms_online.pipeline.white_rows import WhiteRows
from sms_online.pipeline.window_noise import WindowNoise
from sms_online.pipeline.window_whitening import WhitenedWindow, WindowWhitening
from sms_online.state import Stage, State
from sms_online.stream import Array, Mask

# Motion before weights are made, s: at the usual width, four windows side by side.
FIRST_MOTION = 1.6
# Less does where a gap or the end of the session leaves no more.
LEAST_MOTION = 0.4
# What is held back at most, s; the oldest goes, for an arm at rest gives no information.
HELD_BACK = 16.0
# A window moves when a coordinate spans this many σ in it; noise alone spans 6.
MOTION = 20.0
# Multiple of the square of one sample of what noise does beyond first order in a row that estimates its variance in
# the row's own covariance.
UNSTEADY = 4.0
# Time from one check of the weights to the next, s: it doubles from the first to the latest.
FIRST_RENEWAL = 1.0
LATEST_RENEWAL = 4.0
# Weights are renewed where a speed's rows change by this share of their size, or a sensor's density of noise by more
# than what estimates of it scatter by. Less is not worth it: filters whose weights differ by the scatter of an estimate
# take some of that for information.
SAME_ROWS = 2e-3
SAME_NOISE = 0.25
# Parameters with which a speed's rows are smaller than this share of what they were explain nothing.
SHRUNK = 0.5
# Whitening begins anew where what rows leave beyond noise changes by this share of their variance.
SAME_MISFIT = 0.1
# Time for which new weights whiten windows before their rows are taken, s: see `window_whitening`.
WARM_UP = 3.2
# Windows whose rows are made together.
TOGETHER = 64


class MomentumFitState(State):
    """What a fit keeps of the windows so far.

    moving: windows with motion since the segment began. since: windows since the weights were checked; renewal:
    windows from one check to the next. warm: windows that the whitening to come has received, None where none is to
    come. held: windows held back. last: first instant that a window to come asks for, at least; x, v, signals: states
    at the instants from number `first` on.
    """

    x: Array
    v: Array
    signals: Array
    moving: int = 0
    since: int = 0
    renewal: int = 0
    warm: int | None = None
    held: list[Window] = msgspec.field(default_factory=list)
    last: int = 0
    first: int = 0


class MomentumFit(Stage):
    """Whitens the windows of a session, segment by segment.

    new_noise: makes what propagates noise, for the same model, base and balance. solve: gives the estimate so far of
    nuisances and β (m + n,), which weights follow. calibration: rows [N Y b] (k, m + n + 1) of what is known of the
    nuisances beforehand. point: gives the nuisances (m,) that samples are corrected by. sources: whose latencies are
    estimated. prior_information: gives all that is known beside the rows. drift: gives the known drift in the window
    that ends at a grid index. whitening: that of now. torque (n_v,): which speeds' rows hold a torque.
    """

    def __init__(
        self,
        model: Model,
        base: BaseParameters,
        balance: MomentumBalance,
        new_noise: Callable[[], WindowNoise],
        solve: Callable[[], Array],
        calibration: Array,
        point: Callable[[], Array],
        sources: Sequence[SourceGroup] = (),
        prior_information: Callable[[], PriorInformation] | None = None,
        gains: Sequence[int] = (),
        drift: Callable[[int], DriftLine | None] = lambda end: None,
    ) -> None:
        self.model = model
        self.base = base
        self._calibration, self._point = calibration, point
        self._nuisances = calibration.shape[1] - base.n - 1
        inertial = np.isin(
            np.arange(-self._nuisances, base.n), np.flatnonzero(np.isin(base.independent, model.inertial))
        )
        self._balance, self._new_noise, self._sources = balance, new_noise, sources
        self.whitening = self._new_whitening()
        self._next: WindowWhitening | None = None  # with new weights; takes over when it has received enough windows
        self.columns = Columns(self._nuisances, tuple(gains), inertial, self.whitening.noise.multiplied)
        self.described = described(model, base)
        self._solve, self._drift = solve, drift
        self._prior_information = (
            prior_information
            if prior_information is not None
            else lambda: PriorInformation.none(self._nuisances + base.n)
        )
        self._gained = gained(model)
        self.torque = np.isin(np.arange(model.layout.n_v), model.layout.theta_m)
        self._near = near_rows(*self.described, self._nuisances)
        self._first_weights = FirstWeights(
            self.described[0], self._calibration, self.columns, self.torque, self._gained, self._prior_information
        )
        layout = model.layout
        widths = (layout.n_x, layout.n_v, model.n_signals)
        x, v, signals = (np.empty((0, columns)) for columns in widths)
        self.state = MomentumFitState(x, v, signals)
        self._errors = RowErrors(layout.n_v)
        self.plain = PlainRows.none(layout.n_v, base.n, self._nuisances, self.columns.multiplying)

    def renew(self) -> None:
        """See Stage."""
        self._next = None if self.state.warm is None else self._new_whitening()

    def _new_whitening(self) -> WindowWhitening:
        return WindowWhitening(self._new_noise(), COPIES * (self.base.n + 1) + 2 * self._ramps, self._sources)

    @property
    def _ramps(self) -> int:
        """Columns of the parameters' rates."""
        return self.base.n if self._balance.with_moments else 0

    def end_segment(self, noise: SensorNoise) -> list[WhiteRows]:
        """Rows of the windows held back, if they suffice for weights; the next ones share no samples with them."""
        out = self.flush(noise) if self.state.held and self.state.moving >= self._count(LEAST_MOTION) else []
        self._begin_segment()
        return out

    def _begin_segment(self) -> None:
        now = self.state
        now.held, now.moving, now.last, now.first = [], 0, 0, 0
        now.x, now.v, now.signals = now.x[:0], now.v[:0], now.signals[:0]
        if self._next is not None:
            # A filter that begins anew need not be warmed up.
            self._take_over(self._next)
        self.whitening.begin_segment()

    def _take_over(self, whitening: WindowWhitening) -> None:
        """Go on with the whitening that was to come."""
        self.whitening, self._next, self.state.warm = whitening, None, None

    def push(self, windows: list[Window], instants: list[Instants], noise: SensorNoise) -> list[WhiteRows]:
        """Rows of the windows that a push completed, and of those held back before."""
        self.state.x = np.concatenate((self.state.x, *(piece.x for piece in instants)))
        self.state.v = np.concatenate((self.state.v, *(piece.v for piece in instants)))
        self.state.signals = np.concatenate((self.state.signals, *(piece.signals for piece in instants)))
        if self.weights is not None:
            if windows:
                self._check_weights(noise, windows[0])
            self._extend()
            out = self._white(windows)
        else:
            self.state.held += windows
            self.state.moving += sum(self._moves(window, noise) for window in windows)
            out = self.flush(noise) if self.state.moving >= self._count(FIRST_MOTION) else []
            self.state.held = self.state.held[-self._count(HELD_BACK) :]
        self._forget_instants()
        return out

    def go_on(self, weights: Array, noise: SensorNoise, misfit: Array) -> None:
        """Begin with weights β (n,) and a misfit (n_v,) that are known."""
        self.plain.misfit = misfit
        self.whitening.begin(weights, noise, self.plain.misfit, self.state.first)
        self.state.renewal = self._count(FIRST_RENEWAL)

    @property
    def weights(self) -> Array | None:
        """β (n,) behind the weights, None while there are none."""
        return self.whitening.beta

    @property
    def _known_weights(self) -> Array:
        assert self.weights is not None
        return self.weights

    def flush(self, noise: SensorNoise) -> list[WhiteRows]:
        """Fit the windows held back, and return their rows."""
        self.state.moving = 0
        held = self.state.held

        def white(weights: Array) -> list[WhiteRows]:
            self._restart(weights, noise)
            return self._white(held)

        out = white(self._first_weights.of(self._balance.dense(held), self.plain, white))
        self.state.since = 0
        self.state.renewal = self._count(FIRST_RENEWAL)
        self.state.held = []
        return out

    def _count(self, seconds: float) -> int:
        """Windows that begin in so many seconds."""
        return max(1, round(seconds * HOPS / self._balance.span))

    def _moves(self, window: Window, noise: SensorNoise) -> bool:
        inside = slice(window.start - self.state.first, window.start - self.state.first + INSTANTS + 1)
        return bool(np.any(np.ptp(self.state.x[inside], axis=0) > MOTION * noise.coordinates))

    def _check_weights(self, noise: SensorNoise, window: Window) -> None:
        """Now and then, with the window to come: begin to whiten with the estimate and noise so far, if it matters.

        The filter so far goes on until the new one has received enough windows. What the model lacks counts at once: it
        is each row's own, and the memory of such rows is short.
        """
        if self.state.since < self.state.renewal:
            return
        joint = self._solve()
        beta = joint[self._nuisances :]
        self.state.since = 0
        self.state.renewal = min(2 * self.state.renewal, self._count(LATEST_RENEWAL))
        self.plain.judge(joint)
        if self.plain.misfit.any() and self._nuisances:
            beta = self._calibrated(joint)[self._nuisances :]
        used, misfit = self.whitening, self.plain.misfit
        if np.any(np.abs(misfit - used.misfit) > SAME_MISFIT * (1.0 + used.misfit)):
            self._next = self.state.warm = None
            used.begin(beta, noise, misfit, window.start)
        elif self._next is None and self._matters(beta, noise):
            self._next, self.state.warm = self._new_whitening(), 0
            self._next.begin(beta, noise, self.plain.misfit, window.start)
        for whitening in self._whitenings:
            whitening.refer(joint - np.pad(self._point(), (0, self.base.n)))

    def _calibrated(self, joint: Array) -> Array:
        """Nuisances and β (m + n,) that leave no more than noise, where tolerances allow that; or the same.

        Near described values: noise that follows a parameter which rows do not determine would be all that they leave.

        Rows that were whitened as if the model lacked something determine large nuisances too roughly to show it.
        """
        m, squares = self._nuisances, np.einsum("vii->vi", self.plain.gram)[:, self._nuisances : -1]
        known = self._prior_information().beside(self._near)
        found = fitted(self.plain.gram.sum(axis=0), known, m, joint)
        # Rows without a torque leave less where π shrinks.
        shrunk = np.any(squares @ found[m:] ** 2 < SHRUNK**2 * (squares @ joint[m:] ** 2))
        if not shrunk and not self.plain.excess(found).any():
            self.plain.judge(found)
            return found
        return joint

    def _matters(self, beta: Array, noise: SensorNoise) -> bool:
        """Whether β (n,) and the noise of now would change the weights."""
        used = self.whitening.noise
        assert used.sensor_noise is not None
        squares = np.einsum("vii->vi", self.plain.gram)[:, self._nuisances : -1]
        changed, size = (np.sqrt(squares @ values**2) for values in (beta - self._known_weights, beta))
        densities = [(noise.sensors, used.sensor_noise.sensors), (noise.torque, used.sensor_noise.torque)]
        louder = any(np.any(np.abs(now - then) > SAME_NOISE * then) for now, then in densities)
        return bool(np.any(changed > SAME_ROWS * size) or louder)

    def _restart(self, weights: Array, noise: SensorNoise) -> None:
        """Whiten from the first of the windows held back again, with weights β (n,)."""
        self.plain.clear()
        self._errors.begin()
        self.whitening.begin(weights, noise, self.plain.misfit, self.state.first)
        self._extend()

    def _extend(self) -> None:
        """Pass the states of the instants on to what propagates noise."""
        for whitening in self._whitenings:
            whitening.noise.extend(self.state.first, self.state.x, self.state.v, self.state.signals)

    @property
    def lacking(self) -> Mask:
        """Which speeds' rows (n_v,) are weighted by what they leave: more than noise, or a torque of unknown gain."""
        return np.asarray((self.plain.misfit > 0.0) | self._gained)

    @property
    def _whitenings(self) -> list[WindowWhitening]:
        return [self.whitening] if self._next is None else [self.whitening, self._next]

    def _white(self, windows: Sequence[Window]) -> list[WhiteRows]:
        """Rows of the next windows; the whitening to come takes over when it has received enough of them."""
        out: list[WhiteRows] = []
        while len(out) < len(windows):
            count = TOGETHER if self._next is None else self._count(WARM_UP) - (self.state.warm or 0)
            out += self._white_together(windows[len(out) : len(out) + min(TOGETHER, count)])
        return out

    def _white_together(self, windows: Sequence[Window]) -> list[WhiteRows]:
        W, n_v, n = len(windows), self.model.layout.n_v, self.base.n
        rows = self._balance.dense(windows)
        # Columns of parameters that change evenly, and whose rates do, from the grid's beginning on. How a rate changes
        # within a window is nothing to what it does over the windows that whitening looks back at.
        moments, centres = self._balance.moments(windows), self._centres(windows)
        ramp = (centres * rows[:, 0, :, :-1] + moments)[..., : self._ramps]
        bend = (0.5 * centres**2 * rows[:, 0, :, :-1] + centres * moments)[..., : self._ramps]
        weights, misfit, sensors = self._known_weights, self.whitening.misfit, self.whitening.noise.sensor_noise
        assert sensors is not None
        samples = beyond_first_order(rows, weights)
        widths = [window.half_width for window in windows]
        resting = self._balance.rough.resting(np.array([window.rest for window in windows]))
        moving, whole = self._errors.push(widths, samples, resting, size(rows[:, 0], weights))
        errors = whole if misfit.any() else moving
        columns = np.concatenate((rows.swapaxes(1, 2).reshape(W, n_v, -1), ramp, bend), axis=2)
        whitened = self._whiten(windows, columns, errors)
        raw, noisy = rows[:, 0], 0.5 * (rows[:, 1] - rows[:, 2])
        white = np.array([each.rows for each in whitened])
        ramp, bend = np.split(white[..., COPIES * (n + 1) :], 2, axis=2)
        white = white[..., : COPIES * (n + 1)].reshape(W, n_v, COPIES, -1).swapaxes(1, 2)
        bend = bend - centres * ramp + 0.5 * centres**2 * white[:, 0, :, : self._ramps]
        ramp = ramp - centres * white[:, 0, :, : self._ramps]
        drifts = [self._drift(window.end) for window in windows]
        for k, drift in enumerate(drifts):
            if drift is not None:
                # Behind the whitening, for what it subtracts of earlier windows must have the same reference.
                white[k], raw[k] = drift.removed(white[k], ramp[k], bend[k]), drift.removed(raw[k], moments[k])
        if self._nuisances:
            before = np.array([each.calibration[0] for each in whitened])
            behind = np.array([each.calibration[1] for each in whitened])[:, None]
            raw = np.concatenate((before, raw), axis=2)
            white = np.concatenate((np.broadcast_to(behind, (W, COPIES, n_v, self._nuisances)), white), axis=3)
            # Samples are corrected by the point, rows are of the whole nuisances.
            raw[..., -1] += before @ self._point()
            white[..., -1] += behind @ self._point()
        raw, white = np.ascontiguousarray(raw), np.ascontiguousarray(white)
        out = []
        for k, (window, each) in enumerate(zip(windows, whitened, strict=True)):
            # Whether rows hold more than noise is asked of all alike, or the answer would change what is asked.
            variance = np.diag(each.noise) + whole[k] - errors[k]
            self.plain.add(raw[k], noisy[k], variance, weights, each.multiplied[0])
            unsteady = np.diag(UNSTEADY * samples[k] ** 2)
            covariance, noise = each.covariance + unsteady, each.noise + unsteady
            out.append(
                WhiteRows(
                    white[k, 0], white[k, 1:], raw[k], covariance, noise, window.end, each.late, misfit,
                    self._known_weights, self._moves(window, sensors), ramp[k], each.multiplied[1], drifts[k],
                )
            )  # fmt: skip
        return out

    def _centres(self, windows: Sequence[Window]) -> Array:
        """Centres of windows (W, 1, 1), s of the grid."""
        ends = np.array([window.end for window in windows])[:, None, None]
        return np.asarray(ends / self._balance.sample_rate - 0.5 * self._balance.span)

    def _whiten(self, windows: Sequence[Window], rows: Array, errors: Array) -> list[WhitenedWindow]:
        """Rows (W, n_v, width) of the next windows; the whitening to come receives them too, and then may take over."""
        self.state.last = windows[-1].start
        self.state.since += len(windows)
        whitened = self.whitening.push(windows, rows, errors)
        if self._next is not None:
            self._next.push(windows, rows, errors)
            self.state.warm = (self.state.warm or 0) + len(windows)
            if self.state.warm >= self._count(WARM_UP):
                self._take_over(self._next)
                self.state.since = 0
        return whitened

    def _forget_instants(self) -> None:
        """Drop the states that no window to come needs."""
        needed = max(self.state.first, self.state.held[0].start if self.state.held else self.state.last)
        drop = needed - self.state.first
        self.state.first = needed
        self.state.x, self.state.v, self.state.signals = (
            self.state.x[drop:],
            self.state.v[drop:],
            self.state.signals[drop:],
        )
        if self.weights is not None:
            for whitening in self._whitenings:
                whitening.noise.drop(needed)
