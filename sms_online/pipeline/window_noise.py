"""Noise of the rows of a session's windows, propagated from the sensors: for streams and for whole captures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from sms_online.calibration.columns import CalibrationColumns
from sms_online.calibration.multiplied_noise import Multiplied, MultipliedNoise
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.latency import SourceGroup
from sms_online.pipeline.momentum_balance import MomentumBalance
from sms_online.pipeline.momentum_windows import INSTANTS, STEPS, Window
from sms_online.pipeline.row_noise import RowNoise
from sms_online.pipeline.sensitivity import Sensitivities
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.state import Stage, State
from sms_online.stream import Array

# Numbers of the windows' kernels that are processed together: of few sensors NumPy's calls would cost most of it, of
# many sensors all windows at once would fill the memory.
TOGETHER = 2**17


@dataclass(frozen=True)
class PropagatedNoise:
    """Noise of one window's rows.

    covariances: with those of the windows before, then their own; see `RowNoise.covariances`. kernel (STEPS + 1, n_v,
    sensors): see `RowNoise.kernels`, with what slow displacements do by way of rough forces. late (n_v, sensors): see
    `RowNoise.lateness`. calibration (n_v, ·): see `CalibrationColumns.windows`. multiplied (n_v, ·): see
    `MultipliedNoise`.
    """

    covariances: list[Array]
    kernel: Array
    late: Array
    calibration: Array
    multiplied: Array


class WindowNoiseState(State):
    """What the propagation of noise began with.

    beta (n,): β, None before it has begun. sensor_noise: that of then. pushes (K, n_v, components): generalized forces
    of unit wrenches, where any are measured, at the instants from number `first` on.
    """

    beta: Array | None = None
    sensor_noise: SensorNoise | None = None
    pushes: list[Array] = msgspec.field(default_factory=list)
    first: int = 0


class WindowNoise(Stage):
    """Propagates the sensors' noise to the rows of windows, one after the other, with parameters β (n,), see `begin`.

    readings: x (K, n_x) to the displacements (K, n_v, sensors) that unit noise of each position sensor makes. clocks:
    see `RowNoise`. calibration: makes the columns beside Y. n_v: rows of a window. nuisances: columns of calibration.
    multiplied: numbers of those that multiply noise. further: what else multiplies some, behind those.
    """

    def __init__(
        self,
        model: Model,
        base: BaseParameters,
        balance: MomentumBalance,
        readings: Callable[[Array], Array],
        clocks: Sequence[SourceGroup] = (),
        calibration: CalibrationColumns | None = None,
        further: Sequence[Multiplied] = (),
    ) -> None:
        self.n_v = model.layout.n_v
        self._base, self._rough, self._wrenches = base, balance.rough, model.wrenches
        self._joints = len(model.layout.q)
        self._sample_rate = balance.sample_rate
        geometries = () if calibration is None else calibration.geometries
        self._sensitivities = Sensitivities(model, readings, balance.span / INSTANTS, geometries)
        self._noise = RowNoise(model.layout.theta_m, balance.span, clocks)
        self._calibration = calibration
        self.nuisances = 0 if calibration is None else calibration.count
        multiplied = (*(() if calibration is None else calibration.multiplied), *further)
        self.multiplied = tuple(each.column for each in multiplied if each.column is not None)
        sensors = self._sensitivities.sensors
        self._multiplied = MultipliedNoise(multiplied, sensors, model.layout.theta_m, balance.span)
        self.state = WindowNoiseState()

    def begin(self, beta: Array, noise: SensorNoise, instant: int) -> None:
        """Begin with the window that starts at an instant, as if no window before shared samples with it."""
        self.state = WindowNoiseState(beta, noise)
        self.begin_segment(instant)

    def begin_segment(self, instant: int = 0) -> None:
        """The window that starts at an instant is the next, and shares no samples with those before."""
        self._sensitivities.forget(instant)
        if self._calibration is not None:
            self._calibration.forget(instant)
        self._noise.begin_segment()
        self._multiplied.begin_segment()
        self.state.pushes, self.state.first = [], instant

    @property
    def beta(self) -> Array | None:
        """β, None before it has begun."""
        return self.state.beta

    @property
    def sensor_noise(self) -> SensorNoise | None:
        """Noise that β began with."""
        return self.state.sensor_noise

    def extend(self, first: int, x: Array, v: Array, signals: Array) -> None:
        """Take the states (K, ·) of the instants from number `first` on, of which it needs those not taken yet."""
        fresh = self._sensitivities.next_instant - first
        assert self.state.beta is not None
        pi = self._rough.without(self._base.physical_values(self.state.beta))
        x, v, signals = x[fresh:], v[fresh:], signals[fresh:]
        if not len(x):
            return
        if self._wrenches is not None:
            self.state.pushes = [*self.state.pushes, *self._wrenches.by_component(x)]
        by_geometry = self._sensitivities.extend(pi, x, v, signals)
        if self._calibration is not None:
            self._calibration.extend(pi, x, v, signals, self._sensitivities.rates(len(x)), by_geometry)

    def drop(self, instant: int) -> None:
        """Forget what no window that starts at an instant or later needs."""
        self._sensitivities.drop(instant)
        if self._wrenches is not None:
            self.state.pushes, self.state.first = self.state.pushes[instant - self.state.first :], instant
        if self._calibration is not None:
            self._calibration.drop(instant)

    def push(self, windows: Sequence[Window], errors: Array) -> list[PropagatedNoise]:
        """Noise of the next windows; errors (W, n_v): variance of each row that nothing propagates."""
        size = max(1, TOGETHER // (STEPS * self.n_v * self._sensitivities.sensors))
        return [
            noise
            for k in range(0, len(windows), size)
            for noise in self._together(windows[k : k + size], errors[k : k + size])
        ]

    def _together(self, windows: Sequence[Window], errors: Array) -> list[PropagatedNoise]:
        noise, beta = self.state.sensor_noise, self.state.beta
        assert noise is not None
        assert beta is not None
        pi = self._base.physical_values(beta)
        starts = np.array([window.start for window in windows])
        sensitivity = self._sensitivities.windows(starts)
        ages = np.array([window.end for window in windows]) / self._sample_rate
        responses = np.array([window.rough for window in windows]).swapaxes(0, 1)
        rough, slow = (self._rough.kernels(each, pi, sensitivity.displacements) for each in responses)
        smooth = self._noise.kernels(sensitivity)
        kernels, displaced = smooth + rough, smooth + slow
        free = self._rough.at_rest(np.array([window.rest for window in windows]), pi)
        late = self._noise.lateness(displaced, sensitivity.rates)
        wrench = None
        if self._wrenches is not None:
            middles = starts + INSTANTS // 2 - self.state.first
            wrench = np.array([self.state.pushes[k] for k in middles]) * np.sqrt(noise.torque[self._joints :])
        torque = noise.torque[: self._joints]
        jittering = np.concatenate((kernels, self._noise.jittering(kernels, sensitivity.rates, noise.jitters)), axis=3)
        density = np.append(noise.sensors, [each.density for each in noise.jitters])
        covariances = self._noise.covariances(jittering, late, density, torque, free, ages, wrench)
        for each, own in zip(covariances, errors, strict=True):
            diagonal = np.einsum("ii->i", each[-1])
            diagonal += own
        calibration = np.empty((len(windows), self.n_v, 0))
        if self._calibration is not None:
            calibration = self._calibration.windows(starts, sensitivity, slow)
        multiplied = self._multiplied.push(kernels, noise.sensors, torque)
        parts = zip(covariances, displaced, late, calibration, multiplied, strict=True)
        return [PropagatedNoise(*each) for each in parts]
