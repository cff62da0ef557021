"""Nonsmooth forces of effects, which jump or vary faster than the motion, and their noise, from every sample.

Thinned samples would alias such a force: the phase of a cogging behind a gear turns through a radian in a few
milliseconds. Noise reaches it through the filter: what it adds to a row at one instant cancels what it adds a quarter
of a turn later, within the filter's reach.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np

from sms_online.effects.base import STANDSTILL, joints_of
from sms_online.model.model import Model
from sms_online.pipeline.momentum_windows import INSTANTS
from sms_online.pipeline.smoothing import kernel
from sms_online.pipeline.weak_form import effective_samples
from sms_online.stream import Array, Indices, Mask

# Step of the differences that give slopes, rad and rad/s (m, m/s): 1e-9 of a force is lost to curvature where a phase
# turns 300 times as fast as its joint, and as much to rounding.
DIFFERENCE = 1e-6
# Instants of a sample, in samples from its middle, that a force is averaged over which jumps with a rate's sign.
WITHIN = (-0.4, -0.2, 0.0, 0.2, 0.4)
# Rate of an axis that moves off, rad/s (m/s): beyond what a sign is smoothed by, within what friction falls by.
MOVING_OFF = 10.0 * STANDSTILL
# Variance of friction where an axis turns back, over the square of breakaway: its mean is not zero, and rows are not to
# show it.
TURNING_BACK = 3.0


class RoughForces:
    """The forces of a model that are not `smooth`.

    columns (c,): their places in π. rows, coefficients, coordinates (E,): of the entries of `slopes`: generalized
    speed whose row a force is in, place in π of its coefficient, speed along which a position or rate changes; of
    joints' forces, which depend on that joint's positions and rates. axes, dry (D,): of laws of dry friction, speed
    whose sign they follow, place in π of the coefficient.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        layout = model.layout
        rough = [k for k, effect in enumerate(model.effects) if not effect.smooth]
        self.columns = np.concatenate([np.empty(0, dtype=np.int64), *(self._places(k) for k in rough)])
        self._joints = {
            k: sorted({speed for i in joints for speed in (layout.theta_m[i], layout.q[i])})
            for k in rough
            if (joints := joints_of(model.effects[k].where))
        }
        entries = [
            entry for k, speeds in self._joints.items() for entry in product(speeds, speeds, self._places(k).tolist())
        ]
        self.coordinates, self.rows, self.coefficients = np.array(entries, dtype=np.int64).reshape(-1, 3).T
        self._dry = [(k, model.effects[k].axis(layout)) for k in rough if model.effects[k].dry]
        dry = [(axis, place) for k, axis in self._dry for place in self._places(k).tolist()]
        self.axes, self.dry = np.array(dry, dtype=np.int64).reshape(-1, 2).T

    def _places(self, k: int) -> Indices:
        columns = self._model.effect_slices[k]
        return np.arange(columns.start, columns.stop, dtype=np.int64)

    def force(self, x: Array, v: Array, signals: Array, change: Array) -> Array:
        """Columns (K, n_v, n_pi), zero but for these forces, at x (K, n_x), v (K, n_v), signals as in `Instants`.

        change (K, n_v): what the speeds change by in a sample, over which forces are averaged that jump with a rate.
        """
        out = np.zeros((*v.shape, self._model.n_pi))
        for effect, columns, own in self._model.acting(self._model.inputs(signals)):
            if not effect.smooth:
                instants = WITHIN if effect.reversing else (0.0,)
                parts = [effect.force(self._model.layout, x, v + part * change, own) for part in instants]
                out[..., columns] = sum(parts) / len(parts)
        return out

    def slopes(self, x: Array, v: Array, signals: Array, change: Array) -> Array:
        """(K, 2 E): of one unit of each coefficient by position, then by rate, at states as in `force`.

        By rate of the force averaged over a sample. Noise is faster than internal states forget: a state moves with a
        position as its rate does with that speed.
        """
        layout, K = self._model.layout, len(x)
        by_position, by_rate = [np.empty((K, 0))], [np.empty((K, 0))]
        acting = list(self._model.acting(self._model.inputs(np.tile(signals, (4, 1)))))
        for k, speeds in self._joints.items():
            effect, _, own = acting[k]
            assert own is not None
            for speed in speeds:
                within = np.maximum(DIFFERENCE, 0.5 * np.abs(change[:, speed]))
                # Each position there and back, then each rate.
                x_n, v_n, z_n = np.tile(x, (4, 1)), np.tile(v, (4, 1)), own.states.copy()
                x_n[: 2 * K, speed + layout.offset] += np.repeat((DIFFERENCE, -DIFFERENCE), K)
                v_n[2 * K :, speed] += np.concatenate((within, -within))
                if effect.n_states:
                    rates = effect.state_rate(layout, x_n[2 * K :], v_n[2 * K :], z_n[2 * K :])
                    moved = DIFFERENCE * (rates[:K] - rates[K:]) / (2.0 * within[:, None])
                    z_n[: 2 * K] += np.concatenate((moved, -moved))
                there, back, up, down = effect.force(layout, x_n, v_n, replace(own, states=z_n))[:, speeds].reshape(
                    4, K, -1
                )
                by_position.append((there - back) / (2.0 * DIFFERENCE))
                by_rate.append((up - down) / (2.0 * within[:, None]))
        return np.concatenate((*by_position, *by_rate), axis=1)

    def breaking(self, x: Array, v: Array, signals: Array) -> Array:
        """What breaks an axis of dry friction loose (K, D): force of one unit of each coefficient as it moves off."""
        out = np.empty((len(x), self.dry.size))
        acting = list(self._model.acting(self._model.inputs(signals)))
        for k, axis in self._dry:
            effect, _, own = acting[k]
            slow = v.copy()
            slow[:, axis] = MOVING_OFF
            out[:, np.isin(self.dry, self._places(k))] = effect.force(self._model.layout, x, slow, own)[:, axis]
        return out

    def at_rest(self, rest: Array, pi: Array) -> Array:
        """Standard deviation of stiction in the rows: at rest any value up to breakaway, in each half hop.

        (W, INSTANTS, n_v), of parameters π (n_pi,); no half hops for a model without dry friction. rest
        (W, INSTANTS, D): see `stiction_std`.
        """
        by_axis = np.eye(self._model.layout.n_v)[self.axes]
        if not self.dry.size:
            return np.empty((len(rest), 0, by_axis.shape[1]))
        # A negative breakaway is an estimate that went astray; what it would hide is what leads back.
        return np.asarray(np.maximum((rest * pi[self.dry]) @ by_axis, 0.0))

    def resting(self, rest: Array) -> Mask:
        """Rows (W, n_v) in which an axis of dry friction rests or turns back. rest (W, INSTANTS, D): `stiction_std`."""
        out = np.zeros((len(rest), self._model.layout.n_v), dtype=np.bool_)
        for k, axis in enumerate(self.axes):
            out[:, axis] |= rest[..., k].any(axis=1)
        return out

    def without(self, pi: Array) -> Array:
        """π (n_pi,) without the forces that `slopes` covers."""
        out = pi.copy()
        out[self.coefficients] = 0.0
        return out

    def kernels(self, responses: Array, pi: Array, readings: Array) -> Array:
        """What these forces add to `RowNoise.kernels` (W, steps, n_v, sensors), for parameters π (n_pi,).

        responses (W, steps, E): of the windows, of noise or of slow displacements. readings (W, n_v, sensors):
        displacements by each sensor's reading.
        """
        out = np.zeros((*responses.shape[:2], *readings.shape[1:]))
        for row in np.unique(self.rows):
            own = self.rows == row
            out[:, :, row] = (responses[..., own] * pi[self.coefficients[own]]) @ readings[:, self.coordinates[own]]
        return out


def stiction_std(breaking: Array, still: Mask, phi: Array) -> Array:
    """Standard deviation (INSTANTS, D) of the integrals of forces where their axes rest, a half hop at a time.

    As of a force that is another at each sample, so that nothing predicts its course; over a window, all of which
    its axis rests in, as large as breakaway, which is more than it can be. In the few samples of a reversal it hardly
    changes, and has one sign as a rule: its variance is TURNING_BACK times the square of its largest value there.
    breaking (width + 1, D): `RoughForces.breaking` along the window. still (width + 1, D): whether the axis rests, or
    turns back. phi (width + 1,): weights of the integral.
    """
    alike = np.minimum(TURNING_BACK * _lengths(still), effective_samples(phi))
    inside = alike * (phi[:, None] * breaking * still) ** 2
    half_hops = np.arange(0, phi.size - 1, (phi.size - 1) // INSTANTS)
    return np.asarray(np.sqrt(np.add.reduceat(inside[:-1], half_hops)))


def _lengths(still: Mask) -> Array:
    """Length (K, D), in samples, of the stop that each sample belongs to, 0 of one in which the axis moves."""
    number = np.arange(len(still))[:, None]
    before = np.maximum.accumulate(np.where(still, -1, number), axis=0)
    behind = np.minimum.accumulate(np.where(still, len(still), number)[::-1], axis=0)[::-1]
    # One that reaches beyond a window's end is long.
    cut = (before < 0) | (behind == len(still))
    return np.asarray(np.where(still, np.where(cut, len(still), behind - before - 1), 0), dtype=np.float64)


@cache
def _through_filter(half_width: int, width: int, steps: int) -> Array:
    """(2, steps + 1, width + 1): what a reading at even steps of a window does to its samples by way of the filter.

    To the values, and to their changes from sample to sample.
    """
    at = np.arange(width + 1.0)
    interpolation = np.stack([np.interp(np.linspace(0.0, width, steps + 1), at, unit) for unit in np.eye(width + 1)], 1)
    apart = np.arange(width + 1)[:, None] - np.arange(width + 1) + half_width
    inside = (apart >= 0) & (apart <= 2 * half_width)
    passed = np.where(inside, kernel(half_width)[np.where(inside, apart, 0)].transpose(2, 0, 1), 0.0)
    return np.asarray(interpolation @ passed)


@cache
def _at_samples(width: int, steps: int) -> Array:
    """(2, steps + 1, width + 1): what a slow displacement, by its values at steps, is at samples, and its rate there.

    By the width of a window, and in the sum over samples per that over steps.
    """
    at, unit = np.linspace(0.0, 1.0, steps + 1), np.eye(steps + 1)
    values = np.stack([np.interp(np.linspace(0.0, 1.0, width + 1), at, each) for each in unit])
    slopes = np.stack([np.gradient(each, at, edge_order=2) for each in unit])
    return np.asarray(np.stack((values, slopes @ values)) * steps / width)


def responses(slopes: Array, phi: Array, half_width: int, sample_rate: float, steps: int) -> Array:
    """Responses of a row to displacements of a reading, by way of rough forces.

    c (2, steps + 1, E): what a displacement n(t) of a reading adds to a row is ∫ c(t) n(t) dt, for unit coefficients.
    First of noise, which the filter passes in part, by single instants; then of what is slower than the steps, exactly
    as far as it goes on straight between these: a sum over instants of the first would not show that a constant
    displacement adds nothing by a rate.

    slopes (width + 1, 2 E): `RoughForces.slopes` along the window. phi (width + 1,): test function at the samples.
    """
    width = phi.size - 1
    by_value, by_change = _through_filter(half_width, width, steps)
    values, rates = _at_samples(width, steps)
    by_position, by_rate = np.split(phi[:, None] * slopes, 2, axis=1)
    noise = by_value @ by_position + sample_rate * (by_change @ by_rate)
    slow = values @ by_position + sample_rate / width * (rates @ by_rate)
    return -np.stack((noise, slow))
