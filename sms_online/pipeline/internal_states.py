"""Internal states of effects (hysteresis, slosh), advanced along the smoothed motion from sample to sample.

Every ż = A z + b is affine in z, so over a sample interval h, with A at its mean and b linear in time, z follows from
the matrix exponential of h A, here its Padé approximant (2, 2): a liquid at ω keeps its frequency to (ω h)⁴ / 720.
Source: Hochbruck and Ostermann, Exponential integrators, Acta Numerica 19 (2010) 209.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_online.model.model import Model
from sms_online.pipeline.rates import RateSamples
from sms_online.pipeline.synchronise import GridSamples
from sms_online.pipeline.waiting import waiting_from_state, waiting_state
from sms_online.stream import Array


class InternalStates:
    """States z (n_states,) of a model's effects along one gap-free motion, begun as if it had been at rest."""

    def __init__(self, model: Model, sample_rate: float) -> None:
        self.model = model
        self._h = 1.0 / sample_rate
        self.begin_segment()

    def begin_segment(self) -> None:
        """Forget the motion before a gap."""
        self._z = np.empty(0)
        self._A = np.empty((0, self.model.n_states, self.model.n_states))  # of the last sample: ż = A z + b
        self._b = np.empty((0, self.model.n_states))

    def push(self, x: Array, v: Array) -> Array:
        """z (B, n_states) at consecutive samples x (B, n_x), v (B, n_v); other pieces give other last digits."""
        n = self.model.n_states
        out = np.empty((len(x), n))
        if n == 0 or len(x) == 0:
            return out
        b = self.model.state_rate(x, v, np.zeros((len(x), n)))
        units = [np.broadcast_to(unit, (len(x), n)) for unit in np.eye(n)]
        A = np.stack([self.model.state_rate(x, v, unit) - b for unit in units], axis=2)
        begun = 0 if self._z.size else 1
        if begun:
            self._z = out[0] = self.model.initial_state(x[0])
        A_both, b_both = np.concatenate((self._A, A)), np.concatenate((self._b, b))
        X = 0.5 * self._h * (A_both[:-1] + A_both[1:])
        one, twelfth = np.eye(n), X @ X / 12.0
        inverse = np.linalg.inv(one - 0.5 * X + twelfth)
        step = inverse @ (one + 0.5 * X + twelfth)
        change = (b_both[1:] - b_both[:-1])[..., None]
        push = self._h * (inverse @ (b_both[:-1, :, None] + (0.5 * one - X / 12.0) @ change))[..., 0]
        out[begun:] = _along(step, push, self._z)
        self._z, self._A, self._b = out[-1].copy(), A[-1:], b[-1:]
        return out

    def state(self) -> dict[str, Array]:
        """What `restore` needs to continue."""
        return {"z": self._z, "z_A": self._A, "z_b": self._b}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a saved state."""
        self._z, self._A, self._b = (np.array(state[name]) for name in ("z", "z_A", "z_b"))


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


class FollowedStates:
    """Internal states beside the grid samples: these wait until the smoothed motion, and so the states, are known.

    A model without internal states lets its samples pass at once.
    """

    def __init__(self, model: Model, sample_rate: float, channels: int) -> None:
        self._states = InternalStates(model, sample_rate)
        self._n = model.n_states
        self._segment = -1  # of the states
        self._known: list[GridSamples] = []  # states that have met no sample yet
        self._waiting: list[GridSamples] = []
        self._channels = channels

    def wait(self, piece: GridSamples) -> None:
        """Take grid samples of the channels (B, channels)."""
        self._waiting.append(piece)

    def push(self, rates: RateSamples, x: Array, v: Array) -> Array:
        """States (B, n_states) at smoothed samples, which those that wait may meet."""
        if rates.segment != self._segment:
            self._segment = rates.segment
            self._states.begin_segment()
        z = self._states.push(x, v)
        if self._n:
            self._known.append(GridSamples(rates.index, z, rates.segment))
        return z

    def met(self) -> list[GridSamples]:
        """Samples (B, channels + n_states) whose states are known by now; those at a gap have none and are left out."""
        if self._n == 0:
            ready, self._waiting = self._waiting, []
            return ready
        # One piece for each of states, however the samples came: what follows depends on where pieces end.
        out = [self._joined(known) for known in self._known]
        if self._known:
            newest = self._known[-1]
            done = newest.segment, int(newest.index[-1])
            self._waiting = [piece for piece in self._waiting if (piece.segment, int(piece.index[-1])) > done]
            self._known = []
        return out

    def _joined(self, known: GridSamples) -> GridSamples:
        """The samples that wait for `known` states, and these beside them."""
        values = [
            piece.values[(piece.index >= known.index[0]) & (piece.index <= known.index[-1])]
            for piece in self._waiting
            if piece.segment == known.segment
        ]
        return GridSamples(known.index, np.concatenate((np.concatenate(values), known.values), axis=1), known.segment)

    def state(self) -> dict[str, Any]:
        """What `restore` needs to continue, between pushes."""
        waiting = waiting_state("waiting", self._waiting, self._channels)
        return {"segment": self._segment, **waiting, **self._states.state()}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a saved state."""
        self._segment = int(state["segment"])
        self._waiting = waiting_from_state("waiting", state)
        self._states.restore(state)
