"""What a smoother fits at once: a span of samples, the instants of its states, and what the next span goes on from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from sms_online.model.readings import Readings
from sms_online.stream import Array

# Degree of the splines through torques and through states at the nodes: their errors fall faster with the step than
# those of the collocation.
TORQUE_DEGREE = 3
STATE_DEGREE = 5


@dataclass(frozen=True)
class Span:
    """Samples of a span, torques without a gap.

    torque_t (N,), torque (N, joints): n τ on a uniform grid, from the span's begin to its end. t (M,), values (M, C):
    samples of the readings, NaN where a channel has none. guess_t (B,), guess_x (B, n_x), guess_v (B, n_v): the motion
    as far as it is known beforehand. Times in s.
    """

    torque_t: Array
    torque: Array
    t: Array
    values: Array
    guess_t: Array
    guess_x: Array
    guess_v: Array

    @cached_property
    def impulse(self) -> BSpline:
        """∫ n τ dt as a function of time, (·, joints)."""
        return make_interp_spline(self.torque_t, self.torque, k=TORQUE_DEGREE).antiderivative()

    def nodes(self, step: float) -> Array:
        """Instants (K + 1,) from begin to end, evenly at no more than `step`, s."""
        begin, end = self.torque_t[0], self.torque_t[-1]
        return np.linspace(begin, end, 1 + max(STATE_DEGREE, int(np.ceil((end - begin) / step - 1e-9))))

    def guess(self, nodes: Array) -> tuple[Array, Array]:
        """x (K + 1, n_x) and v (K + 1, n_v) at the nodes, constant beyond what is known."""
        both = np.concatenate((self.guess_x, self.guess_v), axis=1)
        at_nodes = np.stack([np.interp(nodes, self.guess_t, column) for column in both.T], axis=1)
        return at_nodes[:, : self.guess_x.shape[1]], at_nodes[:, self.guess_x.shape[1] :]


def interpolated(nodes: Array, values: Array, t: Array) -> Array:
    """Values (M, ·) at instants t (M,) of what is known at the nodes, (K + 1, ·)."""
    return np.asarray(make_interp_spline(nodes, values, k=STATE_DEGREE)(t))


class Ending(NamedTuple):
    """What a span knows of its last state, for the next one, which goes on from there.

    x (n_x,), v (n_v,): the state, with β (n,). Given β it has the covariance rootᵀ root (2 n_v, 2 n_v) in positions and
    momenta, and by another β it is another by by_beta (2 n_v, n).
    """

    x: Array
    v: Array
    beta: Array
    root: Array
    by_beta: Array


class Innovations:
    """Differences of samples and readings, gathered at the nearest nodes.

    A sample is compared with the reading at its own instant; only what a change of the state does to it is taken from
    the node, at most half a step away, which falls out as the search converges. sigma (C,): noise, 1σ a sample.
    """

    def __init__(self, span: Span, nodes: Array, readings: Readings, sigma: Array) -> None:
        self._span = span
        self._nodes = nodes
        self._readings = readings
        step = (nodes[-1] - nodes[0]) / (nodes.size - 1)
        nearest = np.rint((span.t - nodes[0]) / step).astype(np.int64)
        self._nearest = np.clip(nearest, 0, nodes.size - 1)
        self._sampled = np.isfinite(span.values)
        counts = self._sums(self._sampled.astype(np.float64))
        self.weights = np.sqrt(counts) / sigma  # (K + 1, C), one over the noise of the samples' mean
        self._counts = np.maximum(counts, 1.0)

    def _sums(self, samples: Array) -> Array:
        """Sums (K + 1, C) of samples (M, C) over those that are nearest to each node."""
        columns = [np.bincount(self._nearest, column, minlength=self._nodes.size) for column in samples.T]
        return np.stack(columns, axis=1)

    def __call__(self, x: Array, v: Array) -> Array:
        """Mean differences (K + 1, C), in units of their noise, for a motion x (K + 1, n_x), v (K + 1, n_v)."""
        state = interpolated(self._nodes, np.concatenate((x, v), axis=1), self._span.t)
        readings = self._readings(state[:, : x.shape[1]], state[:, x.shape[1] :])
        differences = np.where(self._sampled, self._span.values - readings, 0.0)
        return self.weights * self._sums(differences) / self._counts
