"""Internal states of effects (hysteresis, slosh), advanced along the smoothed motion from sample to sample.

Every ż = A z + b is affine in z, so over a sample interval h, with A at its mean and b linear in time, z follows from
the matrix exponential of h A, here its Padé approximant (2, 2): a liquid at ω keeps its frequency to (ω h)⁴ / 720.
Where h A is large, as of friction that forgets within a sample, that of a part of the interval is doubled.
Source: Hochbruck and Ostermann, Exponential integrators, Acta Numerica 19 (2010) 209; doubling: Skaflestad and Wright,
Applied Numerical Mathematics 59 (2009) 783.
"""

from __future__ import annotations

import msgspec
import numpy as np

from sms_online.description.schema import System
from sms_online.model.model import Model
from sms_online.pipeline.rates import RateSamples
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.smoothing import HALF_WIDTHS, smooth
from sms_online.pipeline.synchronise import GridSamples
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices

# Half width of the filter of the motion behind the states, s, which passes 50 Hz: a hysteresis forgets with every way
# that its spring goes, noise's too. Of short windows it is this multiple at most.
HALF_WIDTH, OF_WINDOW = 0.040, 1.4


def half_width(system: System) -> int:
    """Half width of the filter of the motion that internal states follow, in samples."""
    return max(HALF_WIDTHS[0], round(min(HALF_WIDTH, OF_WINDOW * system.windows.momentum) * system.sample_rate))


def smooth_from_the_start(x: Array, first: int, samples: Indices, M: int, sample_rate: float) -> tuple[Array, Array]:
    """The same as `smooth` with half width M, but near the beginning with as much of the ladder of widths as it allows.

    A mass that rings keeps for good what it has missed of a motion's beginning. first: number of the first of x (B, ·)
    in the segment; samples (n,): numbers too.
    """
    widths = [*(m for m in HALF_WIDTHS if m < M), M]
    own = np.array(widths)[np.searchsorted(widths[1:], samples, side="right")]
    parts = [smooth(x, samples[own == m] - first, m, sample_rate) for m in np.unique(own).tolist()]
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


class InternalState(State):
    """Internal states at the last sample.

    Of the last sample: z (n_states,), and ż = A z + b, A (1, n_states, n_states), b (1, n_states).
    """

    z: Array
    A: Array
    b: Array


class InternalStates(Stage):
    """States z (n_states,) of a model's effects along one gap-free motion, begun as if it had been at rest."""

    def __init__(self, model: Model, sample_rate: float) -> None:
        self.model = model
        self._h = 1.0 / sample_rate
        self.begin_segment()

    def begin_segment(self) -> None:
        """Forget the motion before a gap."""
        n = self.model.n_states
        self.state = InternalState(np.empty(0), np.empty((0, n, n)), np.empty((0, n)))

    def push(self, x: Array, v: Array) -> Array:
        """z (B, n_states) at consecutive samples x (B, n_x), v (B, n_v); other pieces give other last digits."""
        n = self.model.n_states
        out = np.empty((len(x), n))
        if n == 0 or len(x) == 0:
            return out
        b = self.model.state_rate(x, v, np.zeros((len(x), n)))
        units = [np.broadcast_to(unit, (len(x), n)) for unit in np.eye(n)]
        A = np.stack([self.model.state_rate(x, v, unit) - b for unit in units], axis=2)
        begun = 0 if self.state.z.size else 1
        if begun:
            self.state.z = out[0] = self.model.initial_state(x[0])
        A_both, b_both = np.concatenate((self.state.A, A)), np.concatenate((self.state.b, b))
        step, mean, ramp = _exponentials(0.5 * self._h * (A_both[:-1] + A_both[1:]))
        change = (b_both[1:] - b_both[:-1])[..., None]
        push = self._h * (mean @ b_both[:-1, :, None] + ramp @ change)[..., 0]
        out[begun:] = _along(step, push, self.state.z)
        self.state.z, self.state.A, self.state.b = out[-1].copy(), A[-1:], b[-1:]
        return out


def _exponentials(X: Array) -> tuple[Array, Array, Array]:
    """exp(X), φ₁ = (exp(X) - 1) / X and φ₂ = (φ₁ - 1) / X of matrices X (N, n, n)."""
    halvings = np.ceil(np.log2(np.maximum(1.0, np.abs(X).max(axis=(1, 2), initial=0.0)))).astype(np.int64)
    X = X / 2.0 ** halvings[:, None, None]
    one, twelfth = np.eye(X.shape[1]), X @ X / 12.0
    mean = np.asarray(np.linalg.inv(one - 0.5 * X + twelfth))
    step, ramp = mean @ (one + 0.5 * X + twelfth), mean @ (0.5 * one - X / 12.0)
    for k in range(halvings.max(initial=0)):
        more = halvings > k
        ramp[more] = 0.25 * (mean[more] @ mean[more] + 2.0 * ramp[more])
        mean[more] = 0.5 * (step[more] + one) @ mean[more]
        step[more] = step[more] @ step[more]
    return step, mean, ramp


def _along(step: Array, push: Array, z: Array) -> Array:
    """z_k = step_k z_(k-1) + push_k (N, n) from z (n,); step (N, n, n), push (N, n).

    In runs of the root of their number, all runs side by side: from their beginnings first, then from where the one
    before has ended.
    """
    count, n = push.shape
    if count == 0:
        return push
    length = max(1, int(np.sqrt(count)))
    runs = -(-count // length)
    spare = runs * length - count
    steps = np.concatenate((step, np.broadcast_to(np.eye(n), (spare, n, n)))).reshape(runs, length, n, n)
    pushes = np.concatenate((push, np.zeros((spare, n)))).reshape(runs, length, n, 1)
    turned, pushed = np.empty_like(steps), np.empty_like(pushes)
    turned[:, 0], pushed[:, 0] = steps[:, 0], pushes[:, 0]
    for k in range(1, length):
        turned[:, k] = steps[:, k] @ turned[:, k - 1]
        pushed[:, k] = steps[:, k] @ pushed[:, k - 1] + pushes[:, k]
    begin = np.empty((runs, 1, n, 1))
    begin[0, 0, :, 0] = z
    for k in range(1, runs):
        begin[k] = turned[k - 1, -1] @ begin[k - 1] + pushed[k - 1, -1]
    return np.asarray((turned @ begin + pushed).reshape(-1, n)[:count])


class FollowedState(State):
    """Samples that wait for their states, and states that wait to be asked for.

    values (B, channels): samples, from number `first` in the segment on. next: number of the first one whose states
    are not known yet. unasked: states that nobody has asked for.
    """

    values: Array
    segment: int = -1
    first: int = 0
    next: int = HALF_WIDTHS[0]
    unasked: list[GridSamples] = msgspec.field(default_factory=list)


class FollowedStates(Stage):
    """Internal states beside the grid samples: these wait until the motion behind the states is known.

    A model without internal states lets its samples pass at once.
    """

    def __init__(self, model: Model, sensing: Sensing, sample_rate: float) -> None:
        self._states = InternalStates(model, sample_rate)
        self._sensing, self._rate = sensing, sample_rate
        self._n, self._half_width = model.n_states, half_width(model.system)
        self.state = FollowedState(np.empty((0, len(sensing.channels))))

    def _begin_segment(self) -> None:
        self._states.begin_segment()
        self.state.values = self.state.values[:0]
        self.state.first, self.state.next = 0, HALF_WIDTHS[0]

    def push(self, piece: GridSamples) -> list[GridSamples]:
        """Take samples of the channels (B, channels); return those whose states are known (·, channels + n_states).

        Those at a gap have no states and are left out.
        """
        if self._n == 0:
            return [piece]
        if piece.segment != self.state.segment:
            self.state.segment = piece.segment
            self._begin_segment()
        self.state.values = np.concatenate((self.state.values, piece.values))
        end = self.state.first + len(self.state.values)
        samples = np.arange(self.state.next, end - self._half_width)
        if not samples.size:
            return []
        x = self._sensing.coordinates(self.state.values)
        smoothed, rates = smooth_from_the_start(x, self.state.first, samples, self._half_width, self._rate)
        z = self._states.push(smoothed, self._sensing.model.layout.speeds(smoothed, rates))
        index = samples + (int(piece.index[-1]) - (end - 1))
        self.state.unasked.append(GridSamples(index, z, self.state.segment))
        joined = np.concatenate((self.state.values[samples - self.state.first], z), axis=1)
        self.state.next = int(samples[-1]) + 1
        drop = max(0, self.state.next - self._half_width - self.state.first)
        self.state.values, self.state.first = self.state.values[drop:], self.state.first + drop
        return [GridSamples(index, joined, self.state.segment)]

    def beside(self, rates: RateSamples) -> Array:
        """States (B, n_states) at samples that have been known for as long as a filter takes."""
        if self._n == 0:
            return np.empty((len(rates.index), 0))
        own = [piece for piece in self.state.unasked if piece.segment == rates.segment]
        index, z = (np.concatenate([getattr(piece, part) for piece in own]) for part in ("index", "values"))
        self.state.unasked = [
            piece
            for piece in self.state.unasked
            if (piece.segment, int(piece.index[-1])) > (rates.segment, int(rates.index[-1]))
        ]
        return np.asarray(z[np.searchsorted(index, rates.index)])
