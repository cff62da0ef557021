"""The weak-form rows of a whole session with the noise that its sensors propagate into them, to be whitened.

The rows are those of the streaming balance: the same windows, filter widths and noise. What a missing effect adds to
them is a column Z: Y β + Z c = b. Columns pass the same test functions and the same whitening.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.calibration.columns import CalibrationColumns, nuisances
from sms_online.calibration.multiplied_noise import SAMPLES, Multiplied
from sms_online.diagnosis.calibrated import Calibrated
from sms_online.diagnosis.followed import FollowedMotion
from sms_online.diagnosis.record import Segment
from sms_online.diagnosis.weak_rows import WeakRows
from sms_online.diagnosis.weak_windows import WeakWindows, WindowPlaces
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.joint_balance import EXPONENT as JOINT_EXPONENT
from sms_online.pipeline.joint_balance import JointBalance
from sms_online.pipeline.latency import clock_groups
from sms_online.pipeline.momentum_balance import MomentumBalance
from sms_online.pipeline.momentum_windows import COPIES, EXPONENT, STEPS, Instants, Window
from sms_online.pipeline.second_order import SecondOrderNoise, beyond_first_order, numerical, size
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.pipeline.smoothing import smooth_all, stride
from sms_online.pipeline.window_noise import WindowNoise
from sms_online.stream import Array

# Instants at which the sensitivity to noise is computed in one call.
TOGETHER = 64
# The synthetic noise that measures second-order noise is the same in every diagnosis.
SEED = 6
# How many times it is added to see what it makes of a force: averaged over the windows that a window overlaps, a row's
# variance is then known to two fifths.
NOISES = 4
# Beyond any force times a second; squares of it are numbers still.
LARGEST = 1e50
# What channels' effects add to a reading y, for a unit of a coefficient: names of `SessionRows.responses`.
DISPLACEMENTS = ("one", "sine", "cosine", "rate")


def _displacements(readings: Array, rates: Array) -> Array:
    """1, sin y, cos y and ẏ (4, T, sensors)."""
    return np.stack((np.ones_like(readings), np.sin(readings), np.cos(readings), rates))


@dataclass(frozen=True)
class _SegmentRows:
    """What the balance makes of one segment: windows, instants, rows [Y b] of all copies (W, copies, n_v, n + 1).

    displacements (W, 4, STEPS + 1, sensors): of the readings, see DISPLACEMENTS, along each window.
    """

    windows: list[Window]
    instants: list[Instants]
    copies: Array
    displacements: Array


class SessionRows(WeakRows):
    """Rows of the windows of a session.

    time (W,): the windows' middles, s since grid index 0. weak: evaluates further columns. Once they are whitened: beta
    (n,), values behind their noise; second_order: variance of what noise does beyond first order; responses, name to
    (W, n_v, sensors): of the rows to so much added to each position sensor's reading; calibrated: columns of what the
    description may be off by.
    """

    beta: Array
    responses: dict[str, Array]
    calibrated: Calibrated

    def __init__(
        self,
        model: Model,
        base: BaseParameters,
        sensing: Sensing,
        noise: SensorNoise,
        segments: Sequence[Segment],
        beta: Array | None = None,
        second_order: SecondOrderNoise | None = None,
    ) -> None:
        """beta (n,): to whiten the rows with at once. second_order: as of other rows of the session, from synthetic
        noise unless given, which takes three times as long. Raises numpy.linalg.LinAlgError on readings that no shape
        of the links gives, from which rows are no numbers.
        """
        self.model, self.base, self.sensing, self.noise = model, base, sensing, noise
        self.segments = list(segments)
        self._rate = rate = model.system.sample_rate
        self._balance = balance = MomentumBalance(model, base, rate, model.system.windows.momentum, prompt=False)
        self.followed = FollowedMotion(sensing, self.segments, rate)
        self._given = second_order
        if second_order is not None:
            self.second_order = second_order
        added = self._noise_samples(np.random.default_rng(SEED))
        self._parts = [self._of_segment(k, *part) for k, part in enumerate(zip(self.segments, added, strict=True))]
        if not all(np.all(np.abs(part.copies) < LARGEST) for part in self._parts):
            raise np.linalg.LinAlgError("marker readings that do not fit the kinematics of the links")
        windows = [(number, window) for number, part in enumerate(self._parts) for window in part.windows]
        n_v = model.layout.n_v
        stacked = np.concatenate([np.empty((0, n_v, base.n + 1)), *(part.copies[:, 0] for part in self._parts)])
        super().__init__(stacked[..., :-1], stacked[..., -1], rate)
        half = balance.width / 2
        self.time = np.array([window.end - half for _, window in windows]) / rate
        where = WindowPlaces(
            segment=np.array([number for number, _ in windows], dtype=np.int64),
            # The filter of a window's first sample begins with the segment's.
            start=np.array([window.start * balance.half_hop + balance.margin for _, window in windows], dtype=np.int64),
            half_width=np.array([window.half_width for _, window in windows], dtype=np.int64),
            width=balance.width,
            exponent=EXPONENT,
            stride=lambda M: stride(M, balance.hop),
        )
        self.weak = WeakWindows(where, model.layout, sensing, self.segments, rate)
        if beta is not None:
            self.reweight(beta)

    def _noise_samples(self, random: np.random.Generator) -> list[Array]:
        """Noise of position sensors and torques, for each segment's samples (B, channels)."""
        columns = [*self.sensing.position_columns, *self.sensing.torque_columns]
        out = [np.zeros_like(segment.values) for segment in self.segments]
        for added in out:
            added[:, columns] = random.standard_normal((len(added), len(columns))) * self.noise.grid
        return out

    def _of_segment(self, number: int, segment: Segment, added: Array) -> _SegmentRows:
        noise, balance = self.noise, self._balance
        balance.begin_segment()
        followed = self.followed.states(self.model, number)
        measured = self.sensing.motion(np.concatenate((segment.values, followed), axis=1))
        copies = [measured] * COPIES
        if not noise.exact and self._given is None:
            copies[1:] = [
                self.sensing.motion(np.concatenate((segment.values + sign * added, followed), axis=1))
                for sign in (1.0, -1.0)
            ]
        windows, instants = balance.push(segment.index, copies, noise.coordinates, noise.lateness)
        dense = balance.dense(windows)
        displacements = np.empty((0, len(DISPLACEMENTS), STEPS + 1, len(self.sensing.position_columns)))
        if windows:
            readings = self._readings(segment, _middle([window.half_width for window in windows]))
            begin = np.array([window.start * balance.half_hop + balance.margin for window in windows]) / self._rate
            at = begin[:, None] + np.arange(STEPS + 1) * balance.span / STEPS
            added = _displacements(*readings(at.ravel()))
            displacements = added.reshape(len(DISPLACEMENTS), len(windows), STEPS + 1, -1).swapaxes(0, 1)
        return _SegmentRows(windows, instants, dense, displacements)

    def reweight(self, beta: Array) -> None:
        """Propagate noise to the rows with parameters beta (n,), and whiten them."""
        model, balance = self.model, self._balance
        self.beta = self.weights = beta
        if self._given is None:
            self.second_order = self._second_order()
        sensing = self.sensing
        calibration = CalibrationColumns(model, sensing, balance.span)
        known = {each.joints for each in calibration.multiplied}
        joints = [(i,) for i, joint in enumerate(model.system.joints) if not joint.passive]
        gains = [Multiplied(None, joints=each) for each in joints if each not in known]
        noise = WindowNoise(
            model,
            self.base,
            balance,
            sensing.displacements,
            clock_groups(sensing),
            calibration if calibration.count else None,
            gains,
        )
        covariances: list[list[Array]] = []
        responses: list[Array] = []
        columns: list[Array] = []
        synthetic: list[Array] = []
        for part in self._parts:
            noise.begin(beta, self.noise, 0)
            self._extend(noise, part.instants)
            largest = np.maximum.accumulate(size(part.copies[:, 0], beta), axis=0)
            errors = numerical(largest)
            errors += np.array([self.second_order.variance(window.half_width) for window in part.windows]).reshape(
                errors.shape
            )
            for propagated, added in zip(noise.push(part.windows, errors), part.displacements, strict=True):
                covariances.append(propagated.covariances)
                columns.append(propagated.calibration)
                synthetic.append(propagated.multiplied)
                # Sums over the steps, sensor by sensor.
                by_sensor = propagated.kernel.transpose(2, 1, 0) * (balance.span / STEPS)
                responses.append((by_sensor @ added.transpose(2, 1, 0)).transpose(2, 1, 0))
        stacked = np.array(responses).reshape(self.count, len(DISPLACEMENTS), model.layout.n_v, -1)
        self.responses = dict(zip(DISPLACEMENTS, np.moveaxis(stacked, 1, 0), strict=True))
        of_calibration = np.array(columns).reshape(self.count, model.layout.n_v, calibration.count)
        multiplied = (*calibration.multiplied, *gains)
        of_noise = np.array(synthetic).reshape(self.count, model.layout.n_v, len(multiplied), SAMPLES)
        self.calibrated = Calibrated.of(nuisances(sensing), of_calibration, model.system, multiplied, of_noise)
        self.have_noise(covariances)

    def _second_order(self) -> SecondOrderNoise:
        """Second-order noise as in the fit."""
        parts = [part for part in self._parts if part.windows]
        samples = np.concatenate([beyond_first_order(part.copies, self.beta) for part in parts])
        rest = np.array([window.rest for part in parts for window in part.windows])
        return SecondOrderNoise.of(samples, ~self._balance.rough.resting(rest), self.weak.windows.half_width)

    @staticmethod
    def _extend(noise: WindowNoise, instants: list[Instants]) -> None:
        if instants:
            x, v, signals = (np.concatenate([getattr(p, part) for p in instants]) for part in ("x", "v", "signals"))
            for start in range(0, len(x), TOGETHER):
                some = slice(start, start + TOGETHER)
                noise.extend(start, x[some], v[some], signals[some])

    def _readings(self, segment: Segment, half_width: int) -> Callable[[Array], tuple[Array, Array]]:
        """Smoothed readings (T, sensors) of the position sensors, and their rates, at instants (T,) of a segment, s."""
        values = segment.values[:, self.sensing.position_columns]
        samples = np.arange(half_width, len(values) - half_width, max(1, half_width // 4))
        smoothed, rates = (part[samples - half_width] for part in smooth_all(values, half_width, self._rate))

        def at(seconds: Array) -> tuple[Array, Array]:
            place = seconds * self._rate
            return tuple(
                np.stack([np.interp(place, samples, column) for column in part.T], axis=1) for part in (smoothed, rates)
            )  # type: ignore[return-value]

        return at

    def noisy(self) -> list[WeakWindows]:
        """The windows over the same session with synthetic noise of the sensors added, each time another one."""
        random, weak, out = np.random.default_rng(SEED), self.weak, []
        for _ in range(NOISES):
            moved = [
                Segment(segment.index, segment.values + added)
                for segment, added in zip(self.segments, self._noise_samples(random), strict=True)
            ]
            out.append(WeakWindows(weak.windows, self.model.layout, self.sensing, moved, self._rate))
        return out


def _middle(half_widths: list[int]) -> int:
    """Upper median of filters' half widths, which is one of them."""
    return sorted(half_widths)[len(half_widths) // 2]


def joint_windows(rows: SessionRows, gapless: bool = False) -> WeakWindows:
    """The windows of the relative residual over the same session: those of `JointBalance`, all samples seen."""
    system = rows.model.system
    balance = JointBalance(rows.model, rows.base, system.sample_rate, gapless=gapless)
    M = _middle(rows.weak.windows.half_width.tolist())
    starts = [
        np.arange(M, segment.index.size - M - balance.width - 1, balance.hop, dtype=np.int64)
        for segment in rows.segments
    ]
    where = WindowPlaces(
        segment=np.repeat(np.arange(len(starts)), [each.size for each in starts]),
        start=np.concatenate(starts),
        half_width=np.full(sum(each.size for each in starts), M),
        width=balance.width,
        exponent=JOINT_EXPONENT,
        stride=lambda M: 1,
    )
    return WeakWindows(where, rows.model.layout, rows.sensing, rows.segments, system.sample_rate)
