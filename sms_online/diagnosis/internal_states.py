"""Internal states of effects (hysteresis, sloshing liquid), driven by a session's measured motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_online.diagnosis.rows import SessionRows
from sms_online.diagnosis.weak_windows import Motion
from sms_online.effects.base import ForceEffect
from sms_online.model.layout import Layout
from sms_online.pipeline.smoothing import smooth
from sms_online.stream import Array

# Two samples of the motion are a step of Runge and Kutta's method, so many samples of the grid each.
STEP = 2


class InternalStates:
    """States along the segments of a session; they begin anew, at rest, after every gap."""

    def __init__(self, rows: SessionRows) -> None:
        self._rows = rows
        self._motions: dict[int, tuple[NDArray[np.int64], Array, Array]] = {}

    def along(self, effect: ForceEffect, motion: Motion) -> Array:
        """States (K, n_states) of one effect at the samples of a motion."""
        if effect.n_states == 0:
            return np.zeros((len(motion.x), 0))
        if motion.segment not in self._motions:
            self._motions[motion.segment] = self._every_other(motion.segment)
        samples, x, v = self._motions[motion.segment]
        z = integrate(effect, self._rows.model.layout, x, v, STEP / self._rows.model.system.sample_rate)
        return np.stack([np.interp(motion.samples, samples[::2][: len(z)], column) for column in z.T], axis=1)

    def _every_other(self, number: int) -> tuple[NDArray[np.int64], Array, Array]:
        """Numbers (K,) of every STEP-th sample of a segment, x (K, n_x) and v (K, n_v) there."""
        rows = self._rows
        x = rows.sensing.coordinates(rows.segments[number].values)
        M = int(np.median(rows.weak.windows.half_width))
        samples = np.arange(M, len(x) - M, STEP)
        smoothed, rates = smooth(x, samples, M, rows.model.system.sample_rate)
        return samples, smoothed, rows.model.layout.speeds(smoothed, rates)

    def of_model(self, motion: Motion) -> Array:
        """States of all the effects that the model itself has, in their order."""
        effects = self._rows.model.effects
        return np.concatenate([np.zeros((len(motion.x), 0)), *(self.along(e, motion) for e in effects)], axis=1)


def integrate(effect: ForceEffect, layout: Layout, x: Array, v: Array, step: float) -> Array:
    """States at every second instant of a motion x (K, n_x), v (K, n_v), `step` s apart, from rest at the first.

    Runge and Kutta's method of fourth order over two steps, which takes the motion at the middle as it is. Rates are
    affine in the states, so the method's map z to M z + c is known for all steps before the first is taken.
    """
    n = effect.n_states
    b = effect.state_rate(layout, x, v, np.zeros((len(x), n)))
    A = np.stack([effect.state_rate(layout, x, v, np.tile(unit, (len(x), 1))) - b for unit in np.eye(n)], axis=2)
    rates = np.concatenate((A, b[..., None]), axis=2)  # (K, n, n + 1): of the states [z 1]
    now, middle, then = rates[:-2:2], rates[1:-1:2], rates[2::2]
    start = np.concatenate((np.eye(n), np.zeros((n, 1))), axis=1)
    k_1 = now
    k_2 = _applied(middle, start + step * k_1)
    k_3 = _applied(middle, start + step * k_2)
    k_4 = _applied(then, start + 2.0 * step * k_3)
    maps = start + step / 3.0 * (k_1 + 2.0 * k_2 + 2.0 * k_3 + k_4)
    z = effect.initial_state(layout, x[0])
    out = [z]
    for M, c in zip(maps[..., :n], maps[..., n], strict=True):
        z = M @ z + c
        out.append(z)
    return np.array(out)


def _applied(rates: Array, states: Array) -> Array:
    """Rates (K, n, n + 1) of states that are affine themselves in those at the start, (K, n, n + 1)."""
    out = rates[..., :-1] @ states
    out[..., -1] += rates[..., -1]
    return np.asarray(out)
