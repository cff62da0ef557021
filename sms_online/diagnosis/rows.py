"""The weak-form rows of a whole session with the noise that its sensors propagate into them, to be whitened.

The rows are those of the streaming balance: the same windows, filter widths and noise. What a missing effect adds to
them is a column Z: Y β + Z c = b. Columns pass the same test functions and the same whitening.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.linalg

from sms_online.diagnosis.followed import FollowedMotion
from sms_online.diagnosis.record import Segment
from sms_online.diagnosis.weak_windows import WeakWindows, Windows
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.joint_balance import EXPONENT as JOINT_EXPONENT
from sms_online.pipeline.joint_balance import JointBalance
from sms_online.pipeline.momentum_balance import COPIES, EXPONENT, INSTANTS, Instants, MomentumBalance, Window
from sms_online.pipeline.row_noise import STEPS, RowNoise, factored
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensitivity import Sensitivities
from sms_online.pipeline.sensor_noise import FINEST, SensorNoise
from sms_online.pipeline.smoothing import smooth, stride
from sms_online.stream import Array

# Instants that the sensitivity to noise is told at in one call.
TOLD = 64
# The synthetic noise that tells what noise does beyond first order is the same in every diagnosis.
SEED = 6
# What channels' effects add to a reading y, for a unit of a coefficient: names of `SessionRows.responses`.
DISPLACEMENTS = ("one", "sine", "cosine", "rate")


def _displacements(readings: Array, rates: Array) -> Array:
    """1, sin y, cos y and ẏ (4, T, sensors)."""
    return np.stack((np.ones_like(readings), np.sin(readings), np.cos(readings), rates))


class SessionRows:
    """Rows of the windows of a session, n_v a window.

    beta (n,): values behind the noise of the rows. Y (W, n_v, n), b (W, n_v): rows as they are. std (W, n_v): their own
    predicted deviation. time (W,): the windows' middles, s since grid index 0. weak: evaluates further columns.
    """

    def __init__(
        self,
        model: Model,
        base: BaseParameters,
        sensing: Sensing,
        noise: SensorNoise,
        segments: Sequence[Segment],
        beta: Array,
    ) -> None:
        self.model, self.base, self.sensing, self.noise, self.beta = model, base, sensing, noise, beta
        self.segments = list(segments)
        self._rate = rate = model.system.sample_rate
        balance = MomentumBalance(model, base, rate, model.system.windows.momentum, prompt=False)
        self._random = np.random.default_rng(SEED)
        self._covariances: list[list[Array]] = []
        self._responses: list[Array] = []
        windows: list[tuple[int, Window]] = []
        rows: list[Array] = []
        self.followed = FollowedMotion(sensing, self.segments, rate)
        for number, segment in enumerate(self.segments):
            for window, dense in self._of_segment(balance, number, segment):
                windows.append((number, window))
                rows.append(dense)
        n_v = model.layout.n_v
        stacked = np.array(rows).reshape(-1, n_v, base.n + 1)
        self.Y, self.b = stacked[..., :-1], stacked[..., -1]
        self.std = np.sqrt([np.diag(covariances[-1]) for covariances in self._covariances]).reshape(-1, n_v)
        # Responses (W, n_v, sensors) of the rows to so much added to each position sensor's reading.
        sensors = len(sensing.position_columns)
        responses = np.array(self._responses).reshape(len(windows), len(DISPLACEMENTS), n_v, sensors)
        self.responses = dict(zip(DISPLACEMENTS, np.moveaxis(responses, 1, 0), strict=True))
        half = balance.width / 2 + balance.margin
        self.time = np.array([window.end - half for _, window in windows]) / rate
        where = Windows(
            segment=np.array([number for number, _ in windows], dtype=np.int64),
            # The filter of a window's first sample begins with the segment's.
            start=np.array([window.start * balance.half_hop + balance.margin for _, window in windows], dtype=np.int64),
            half_width=np.array([window.half_width for _, window in windows], dtype=np.int64),
            width=balance.width,
            exponent=EXPONENT,
            stride=lambda M: stride(M, balance.hop),
        )
        self.weak = WeakWindows(where, model.layout, sensing, self.segments, rate)
        self.whiten(np.zeros(n_v))

    def _of_segment(self, balance: MomentumBalance, number: int, segment: Segment) -> list[tuple[Window, Array]]:
        """Windows of one segment with their rows [Y b] (n_v, n + 1); their covariances are appended to the others."""
        noise, n_v = self.noise, self.model.layout.n_v
        balance.begin_segment()
        followed = self.followed.states(self.model, number)
        measured = self.sensing.motion(np.concatenate((segment.values, followed), axis=1))
        copies = [measured] * COPIES
        if not noise.exact:
            added = np.zeros_like(segment.values)
            columns = [*self.sensing.position_columns, *self.sensing.torque_columns]
            added[:, columns] = self._random.standard_normal((len(measured), len(columns))) * noise.grid
            copies[1:] = [
                self.sensing.motion(np.concatenate((segment.values + sign * added, followed), axis=1))
                for sign in (1.0, -1.0)
            ]
        windows, instants = balance.push(segment.index, copies, noise.coordinates)
        if not windows:
            return []
        sensitivities = self._sensitivities(instants, balance.span)
        row_noise = RowNoise(self.model.layout.theta_m, balance.span)
        readings = self._readings(segment, _middle([window.half_width for window in windows]))
        seconds = np.arange(STEPS + 1) * balance.span / STEPS
        dense = np.zeros((len(windows), COPIES, n_v, self.base.n + 1))
        for rows, window in zip(dense, windows, strict=True):
            rows[:, balance.rows, balance.columns] = window.Y
            rows[:, :, -1] = window.b
        extra = self._beyond_first_order(dense, [window.half_width for window in windows])
        for window, variance in zip(windows, extra, strict=True):
            sensitivity = sensitivities.window(window.start)
            covariances = row_noise.covariance(sensitivity, noise.sensors, noise.torque)
            covariances[-1][np.diag_indices(n_v)] += variance
            self._covariances.append(covariances)
            begin_s = (window.start * balance.half_hop + balance.margin) / self._rate
            added = _displacements(*readings(begin_s + seconds))
            kernel = row_noise.kernel(sensitivity) * (balance.span / STEPS)
            self._responses.append(np.einsum("sij,dsj->dij", kernel, added))
        return list(zip(windows, dense[:, 0], strict=True))

    def _beyond_first_order(self, dense: Array, half_widths: list[int]) -> Array:
        """Variance (W, n_v) of what noise does beyond first order, by filter width, and of rounding, as in the fit."""
        residual = dense[..., -1] - dense[..., :-1] @ self.beta
        squares = (0.5 * (residual[:, 1] + residual[:, 2]) - residual[:, 0]) ** 2
        widths = np.array(half_widths)
        means = {M: squares[widths == M].mean(axis=0) for M in set(half_widths)}
        # A narrow filter lets through no less than the wide ones do, however few windows it has been used for.
        bent = {M: np.max([mean for wide, mean in means.items() if wide >= M], axis=0) for M in means}
        size = np.abs(dense[:, 0, :, :-1]) @ np.abs(self.beta) + np.abs(dense[:, 0, :, -1])
        rounding = (FINEST * np.maximum.accumulate(size, axis=0)) ** 2 + np.finfo(np.float64).tiny
        return np.array([bent[M] for M in half_widths]) + rounding

    def _readings(self, segment: Segment, half_width: int) -> Callable[[Array], tuple[Array, Array]]:
        """Smoothed readings (T, sensors) of the position sensors, and their rates, at instants (T,) of a segment, s."""
        values = segment.values[:, self.sensing.position_columns]
        samples = np.arange(half_width, len(values) - half_width, max(1, half_width // 4))
        smoothed, rates = smooth(values, samples, half_width, self._rate)

        def at(seconds: Array) -> tuple[Array, Array]:
            place = seconds * self._rate
            return tuple(
                np.stack([np.interp(place, samples, column) for column in part.T], axis=1) for part in (smoothed, rates)
            )  # type: ignore[return-value]

        return at

    def _sensitivities(self, instants: list[Instants], span: float) -> Sensitivities:
        out = Sensitivities(self.model, self.sensing.displacements, span / INSTANTS)
        pi = self.base.physical_values(self.beta)
        parts = [np.concatenate([getattr(piece, part) for piece in instants]) for part in ("x", "v", "signals")]
        for start in range(0, len(parts[0]), TOLD):
            out.tell(pi, *(part[start : start + TOLD] for part in parts))
        return out

    @property
    def count(self) -> int:
        """Number of windows W."""
        return len(self._covariances)

    def whiten(self, floor: Array) -> None:
        """Make the windows' rows independent; floor (n_v,): share of a row's variance that is an error of its own."""
        n_v = self.model.layout.n_v
        self._operators: list[tuple[Array, Array]] = []
        L = np.empty((0, 0))
        for covariances in self._covariances:
            L = factored(L, covariances, floor)
            self._operators.append((L[-n_v:, :-n_v].copy(), L[-n_v:, -n_v:].copy()))

    def white(self, columns: Array) -> Array:
        """Columns (W, n_v, c) in the whitened rows, (W n_v, c)."""
        n_v, c = columns.shape[1:]
        out = np.empty((self.count * n_v, c))
        for k, (X, diagonal) in enumerate(self._operators):
            begin = k * n_v
            rows = columns[k] - X @ out[begin - X.shape[1] : begin]
            out[begin : begin + n_v] = scipy.linalg.solve_triangular(diagonal, rows, lower=True, check_finite=False)
        return out

    def freedom(self, speeds: Sequence[int]) -> float:
        """Degrees of freedom of the mean square of some speeds' rows over their variance, which overlapping rows share.

        2 / variance of the mean of squares of correlated normal numbers: (W S)² / Σ ρ².
        """
        total = 0.0
        deviations = [np.sqrt(np.diag(covariances[-1]))[list(speeds)] for covariances in self._covariances]
        for k, covariances in enumerate(self._covariances):
            for lag, block in enumerate(reversed(covariances)):
                scale = np.outer(deviations[k], deviations[k - lag])
                part = float(np.sum((block[np.ix_(speeds, speeds)] / scale) ** 2))
                total += part if lag == 0 else 2.0 * part
        return (self.count * len(speeds)) ** 2 / total


def _middle(half_widths: list[int]) -> int:
    """Upper median of filters' half widths, which is one of them."""
    return sorted(half_widths)[len(half_widths) // 2]


def joint_windows(rows: SessionRows) -> WeakWindows:
    """The windows of the relative residual over the same session: those of `JointBalance`, all samples seen."""
    system = rows.model.system
    balance = JointBalance(rows.model, rows.base, system.sample_rate)
    M = _middle(rows.weak.windows.half_width.tolist())
    starts = [
        np.arange(M, segment.index.size - M - balance.width - 1, balance.hop, dtype=np.int64)
        for segment in rows.segments
    ]
    where = Windows(
        segment=np.repeat(np.arange(len(starts)), [each.size for each in starts]),
        start=np.concatenate(starts),
        half_width=np.full(sum(each.size for each in starts), M),
        width=balance.width,
        exponent=JOINT_EXPONENT,
        stride=lambda M: 1,
    )
    return WeakWindows(where, rows.model.layout, rows.sensing, rows.segments, system.sample_rate)
