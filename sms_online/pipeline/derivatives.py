"""Derivatives of momentum and force by displacements, speeds and what geometry is off by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.calibration.geometry import STEP, Geometry, same_readings
from sms_online.model.dynamics import Dynamics
from sms_online.model.model import Model
from sms_online.model.so3 import skew
from sms_online.stream import Array, Mask

# Step of the differences by displacements, m and rad: 1e-8 of a derivative is lost to curvature, as much to rounding.
DIFFERENCE = 1e-6
# States that pass together, of a long motion: more would fill the memory.
TOGETHER = 4000


class Derivatives:
    """Derivatives of momentum P π and force G π of a model and of what some geometries change them by.

    NumPy's calls cost more than the few states of a window: displaced states and moved geometries pass as one batch.
    No speed need be changed: P = ∂K/∂v and G = ∂K/∂x, but for forces, so that ∂G/∂v is the transpose of ∂P/∂x.
    """

    def __init__(self, model: Model, geometries: Sequence[Geometry] = ()) -> None:
        self._model = model
        self._models = [model, *(model.of_geometry(each.moved(model.system, STEP)) for each in geometries)]
        pairs = [zip(each.chain.flexible, model.chain.flexible, strict=True) for each in self._models]
        # Those whose springs are others: strains of exact links follow from markers.
        self._elastic = [k for k, links in enumerate(pairs) if any(link is not own for link, own in links)]
        self._pi, self._counts = np.empty(0), (0, 0)

    def _renew(self, pi: Array, counts: tuple[int, int]) -> None:
        """Equations of motion for parameters π, of so many states of this model and of each other: rarely others."""
        if counts != self._counts or not np.array_equal(pi, self._pi):
            self._pi, self._counts = pi, counts
            repeats = [counts[0], *[counts[1]] * (len(self._models) - 1)]
            self._stacked = self._model.stacked(self._models, repeats).dynamics(pi)
            self._each = [model.dynamics(pi) for model in self._models]

    def at(self, pi: Array, x: Array, v: Array, signals: Array | None, H: Array, chosen: Mask) -> tuple[Array, Array]:
        """∂Pπ/∂x, ∂Gπ/∂v and ∂Gπ/∂x side by side (·, n_v, 3 n_v) at the chosen ones of K states, K of them or fewer;
        and ∂Pπ and ∂Gπ (2, K, n_v, c) by geometries, readings staying as they are.

        x (K, n_x), v (K, n_v). signals (K, n_signals): see `Model.inputs`, for the effects that need
        them. H (K, n_v, n_v): mass matrices.
        """
        n_v = v.shape[1]
        size = max(1, TOGETHER // (n_v + len(self._models)))
        if len(x) > size:
            parts = []
            for part in (slice(k, k + size) for k in range(0, len(x), size)):
                inputs = None if signals is None else signals[part]
                parts.append(self.at(pi, x[part], v[part], inputs, H[part], chosen[part]))
            return np.concatenate([one for one, _ in parts]), np.concatenate([one for _, one in parts], axis=1)
        K, some = len(x), int(np.count_nonzero(chosen))
        self._renew(pi, (K + some * n_v, K))
        model, dynamics = self._model, self._each[0]
        there, speeds = np.repeat(x[chosen], n_v, axis=0), np.repeat(v[chosen], n_v, axis=0)
        steps = DIFFERENCE * np.tile(np.eye(n_v), (some, 1))
        displaced = there + model.position_rate(there, steps)
        moved = [same_readings(model, other, x, v) for other in self._models[1:]]
        xs, vs = zip((x, v), (displaced, speeds), *moved, strict=True)
        p, g = self._stacked.momentum_and_force(np.concatenate(xs), np.concatenate(vs))
        p_0, g_0 = p[:K], g[:K]
        P_x, G_x = (
            ((part[K : K + some * n_v].reshape(some, n_v, n_v) - at[chosen, None]) / DIFFERENCE).swapaxes(1, 2)
            for part, at in ((p, p_0), (g, g_0))
        )
        G_v = self._force_by_speed(P_x, v[chosen], p_0[chosen], H[chosen]) - dynamics.damping
        G_x = G_x - dynamics.stiffness
        if model.effects:
            by_speed, by_position = _effects(dynamics, x[chosen], v[chosen], displaced, steps, signals, chosen)
            G_v, G_x = G_v + by_speed, G_x + by_position
        change = np.array((p, g))[:, K + some * n_v :].reshape(2, len(moved), K, n_v)
        change -= np.array((p_0, g_0))[:, None]
        for k in self._elastic:
            change[1, k - 1] += self._each[k].spring_force(moved[k - 1][0], moved[k - 1][1])
            change[1, k - 1] -= dynamics.spring_force(x, v)
        if model.effects and moved:
            inputs_of = None if signals is None else model.inputs(signals)
            own = dynamics.effect_force(x, v, inputs_of)
            for out, each, (at_x, at_v) in zip(change[1], self._each[1:], moved, strict=True):
                out += each.effect_force(at_x, at_v, inputs_of) - own
        return np.concatenate((P_x, G_v, G_x), axis=2), np.moveaxis(change, 1, 3) / STEP

    def _force_by_speed(self, P_x: Array, v: Array, p: Array, H: Array) -> Array:
        """∂Gπ/∂v (K, n_v, n_v) of ∂K/∂x alone.

        A free base's moments about S obey ṗ_ω + v_S × p_S = Q, and its forces ṗ_S = Q, in inertial axes.
        """
        layout = self._model.layout
        out = P_x.swapaxes(1, 2).copy()
        linear, base = len(layout.base_linear), layout.n_base_speeds
        out[:, :base] = 0.0
        if linear:
            velocity, momentum = np.zeros((2, len(v), 3))
            velocity[:, list(layout.base_linear)] = v[:, :linear]
            momentum[:, list(layout.base_linear)] = p[:, :linear]
            by_speed = np.zeros((len(v), 3, v.shape[1]))
            by_speed[:, list(layout.base_linear)] = H[:, :linear]
            moment = -skew(velocity) @ by_speed
            moment[:, :, :linear] += skew(momentum)[:, :, list(layout.base_linear)]
            out[:, linear:base] = moment[:, list(layout.base_angular)]
        return out


def _effects(
    dynamics: Dynamics, x: Array, v: Array, displaced: Array, steps: Array, signals: Array | None,
    chosen: Mask,
) -> tuple[Array, Array]:  # fmt: skip
    """Derivatives (K, n_v, n_v) of the effects' forces by speeds and by displacements, at x (K, n_x), v (K, n_v).

    displaced (K n_v, n_x): the states moved by steps (K n_v, n_v). signals: of all states, of which K are chosen.
    """
    K, n_v = v.shape
    speeds = np.repeat(v, n_v, axis=0)
    inputs = None
    if signals is not None:
        own = signals[chosen]
        repeated = np.repeat(own, n_v, axis=0)
        inputs = dynamics.model.inputs(np.concatenate((own, repeated, repeated)))
    there = np.concatenate((x, np.repeat(x, n_v, axis=0), displaced)), np.concatenate((v, speeds + steps, speeds))
    force, by_speed, by_position = np.split(dynamics.effect_force(*there, inputs), [K, K + K * n_v])
    at = force[:, None]
    of_speed, of_position = (part.reshape(K, n_v, n_v) - at for part in (by_speed, by_position))
    return of_speed.swapaxes(1, 2) / DIFFERENCE, of_position.swapaxes(1, 2) / DIFFERENCE
