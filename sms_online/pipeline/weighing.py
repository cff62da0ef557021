"""Windows weighed one after the other with the same parameters: a chain of rows, each told apart from all before it.

What rows of neighbouring windows do not share is what they tell, and a row is told apart from the nine windows that
overlap its own better with what these were themselves told apart from: the noise is a moving average whose sum over
all windows nearly vanishes, and such a one is foreseen from its whole past only. A chain that begins anew knows less
for a second or two, and calls its rows independent of those before, which they are not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.latency import LatencyColumns, SourceGroup
from sms_online.pipeline.momentum_balance import MomentumBalance
from sms_online.pipeline.momentum_windows import COPIES, INSTANTS, Instants, Probes, Window
from sms_online.pipeline.row_noise import RowNoise, Whitener
from sms_online.pipeline.sensitivity import Sensitivities
from sms_online.pipeline.sensor_noise import SensorNoise, noise_from_state, noise_state
from sms_online.stream import Array


@dataclass(frozen=True)
class Weighed:
    """A window's rows (n_v, width), independent of all before and of each other, errors of unit variance.

    late (n_v, G): columns of the sources' latencies, likewise. noise (n_v, n_v): covariance of the rows as they came,
    as far as it is noise; covariance (n_v, n_v): with what the model lacks.
    """

    rows: Array
    late: Array
    noise: Array
    covariance: Array


class Weighing:
    """Weighs windows with parameters β (n,), noise of the sensors, and a misfit (n_v,), see `begin`.

    readings: x (K, n_x) to the displacements (K, n_v, sensors) that unit noise of each position sensor makes. sources:
    whose latencies are told. clocks: see `RowNoise`. beta: β, None before it has begun.
    """

    def __init__(
        self,
        model: Model,
        base: BaseParameters,
        balance: MomentumBalance,
        readings: Callable[[Array], Array],
        sources: Sequence[SourceGroup] = (),
        clocks: Sequence[SourceGroup] = (),
    ) -> None:
        n_v = model.layout.n_v
        self._base, self._rough = base, balance.rough
        self._sample_rate = balance.sample_rate
        self._sensitivities = Sensitivities(model, readings, balance.span / INSTANTS)
        self._noise = RowNoise(model.layout.theta_m, balance.span, clocks)
        self._late = LatencyColumns(sources)
        self._whitener = Whitener(n_v, COPIES * (base.n + 1) + len(sources))
        self.beta: Array | None = None
        self.misfit = np.zeros(n_v)
        self.sensor_noise: SensorNoise | None = None

    def begin(self, beta: Array, noise: SensorNoise, misfit: Array, instant: int) -> None:
        """Begin a chain with the window that starts at an instant, as if no window before shared samples with it.

        misfit (n_v,): variance of what the model lacks in each row, over that of the noise.
        """
        self.beta, self.sensor_noise, self.misfit = beta, noise, misfit
        self.begin_segment(instant)

    def begin_segment(self, instant: int = 0) -> None:
        """The window that starts at an instant is the next, and shares no samples with those before."""
        self._sensitivities.forget(instant)
        self._noise.begin_segment()
        self._whitener.begin_segment()

    @property
    def probes(self) -> Probes:
        """At which states it wants columns of new instants."""
        return self._sensitivities.probes

    def tell(self, first: int, x: Array, v: Array, signals: Array, instants: Sequence[Instants] = ()) -> None:
        """Take the states (K, ·) of the instants from number `first` on, of which it needs those not told yet.

        instants: those that came last, with columns where they were probed.
        """
        needed = self._sensitivities.next_instant
        fresh = needed - first
        assert self.beta is not None
        pi = self._rough.without(self._base.physical_values(self.beta))
        probed = next((piece.probed for piece in instants if piece.number == needed), None)
        self._sensitivities.tell(pi, x[fresh:], v[fresh:], signals[fresh:], probed)

    def drop(self, instant: int) -> None:
        """Forget what no window that starts at an instant or later asks for."""
        self._sensitivities.drop(instant)

    def push(self, window: Window, rows: Array, errors: Array) -> Weighed:
        """The next window's rows (n_v, width); errors (n_v,): variance of each that nothing propagates."""
        assert self.sensor_noise is not None
        assert self.beta is not None
        pi = self._base.physical_values(self.beta)
        sensitivity = self._sensitivities.window(window.start)
        age = window.end / self._sample_rate
        kernel = self._noise.kernel(sensitivity) + self._rough.kernel(window.rough, pi, sensitivity.displacements)
        noise = self.sensor_noise
        free = self._rough.at_rest(window.rest, pi)
        covariances = self._noise.covariance(kernel, sensitivity.rates, noise.sensors, noise.torque, free, age)
        own = covariances[-1]
        diagonal = np.einsum("ii->i", own)
        diagonal += errors
        of_noise = own.copy()
        diagonal += self.misfit * diagonal
        width = rows.shape[1]
        if len(self._late):
            rows = np.concatenate((rows, self._late.of(self._noise.late)), axis=1)
        white = self._whitener.push(covariances, rows)
        return Weighed(white[:, :width], white[:, width:], of_noise, own)

    def state(self) -> dict[str, Any]:
        """What `restore` needs to continue."""
        return {
            "weights": np.empty(0) if self.beta is None else self.beta, "weighed_misfit": self.misfit,
            **self._noise.state(), **self._whitener.state(),
            **self._sensitivities.state(), **noise_state("weighed", self.sensor_noise),
        }  # fmt: skip

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a saved state."""
        self.beta = np.array(state["weights"]) if state["weights"].size else None
        self.misfit = np.array(state["weighed_misfit"])
        self._sensitivities.restore(state)
        self._noise.restore(state)
        self._whitener.restore(state)
        self.sensor_noise = noise_from_state("weighed", state)
