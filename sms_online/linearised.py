"""Equations of motion and readings of the sensors, linearised along a motion.

With the momentum p = ∂K/∂v as half of the state, s = [δx, δp] (attitude as a small inertial rotation), the balance
d/dt(P π) - G π = Q, (33)-(38), is linearised about a motion in this form:

    δv = H⁻¹ (δp - ∂Pπ/∂x δx - P δβ),    d/dt δp = ∂Gπ/∂x δx + ∂Gπ/∂v δv + G δβ + δQ,

without accelerations, which a jolt makes large and a capture does not hold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_online.model.base_parameters import BaseParameters
from sms_online.model.dynamics import Dynamics
from sms_online.model.readings import Readings
from sms_online.model.so3 import skew
from sms_online.pipeline.derivatives import Derivatives
from sms_online.stream import Array


@dataclass(frozen=True)
class Motion:
    """A motion at a uniform step: t (B,) s, x (B, n_x), v (B, n_v) in the order of the model's layout.

    inputs (B, inputs): what is measured beside, see `Inputs.torque`; a motion under wrenches needs it.
    """

    t: Array
    x: Array
    v: Array
    inputs: Array | None = None

    @property
    def step(self) -> float:
        """Time from one instant to the next, s."""
        return float((self.t[-1] - self.t[0]) / (self.t.size - 1))


@dataclass(frozen=True)
class LinearSystem:
    """The linearised system at B instants, m = 2 n_v states.

    A (B, m, m): of ṡ = A s. E (B, m, inputs + n): columns by which torques n τ, wrenches and parameters β drive ṡ.
    C (B, channels, m), D (B, channels, n): readings by s and by β. V (B, n_v, m): speeds by s; by β they are the first
    rows of E. H (B, n_v, n_v): mass matrix.
    """

    A: Array
    E: Array
    C: Array
    D: Array
    V: Array
    H: Array


def linearise(
    dynamics: Dynamics, base: BaseParameters, readings: Readings, x: Array, v: Array, every: int = 1,
    inputs: Array | None = None,
) -> LinearSystem:  # fmt: skip
    """The balance and the readings, linearised at x (B, n_x), v (B, n_v).

    every: derivatives by displacements and of readings are evaluated at one instant in so many, and interpolated.
    inputs (B, inputs): see `Motion`.
    """
    model, layout = dynamics.model, dynamics.model.layout
    (B, n_v), count = v.shape, model.n_inputs
    nodes = np.unique(np.append(np.arange(0, B, every), B - 1))
    weights = np.stack([np.interp(np.arange(B), nodes, unit) for unit in np.eye(nodes.size)], axis=1)

    def interpolated(at_nodes: Array) -> Array:
        return np.asarray(np.tensordot(weights, at_nodes, 1))

    H = dynamics.mass_matrix(x)
    derivatives, _ = Derivatives(model).at(
        dynamics.pi,
        x[nodes],
        v[nodes],
        None if inputs is None else inputs[nodes],
        H[nodes],
        np.ones(nodes.size, dtype=np.bool_),
    )
    P_x, G_v, G_x = np.split(interpolated(derivatives), 3, axis=2)
    C_x, C_v = (interpolated(part) for part in readings.derivatives(x[nodes], v[nodes]))
    P, G = (
        base.columns(part)
        for part in model.momentum_columns(x, v, inputs=None if inputs is None else model.inputs(inputs))
    )
    # δv by δx, δp and δβ.
    v_p = np.linalg.inv(H)
    v_x, v_beta = -v_p @ P_x, -v_p @ P
    V = np.concatenate((v_x, v_p), axis=2)
    A = np.concatenate((V, np.concatenate((G_x + G_v @ v_x, G_v @ v_p), axis=2)), axis=1)
    if layout.free and not layout.planar:
        # A small inertial rotation φ of the attitude obeys φ̇ = δω + ω × φ.
        A[:, 3:6, 3:6] += skew(v[:, 3:6])
    E = np.zeros((B, 2 * n_v, count + base.n))
    E[:, n_v:, :count] = model.input_columns(x)
    E[:, :n_v, count:], E[:, n_v:, count:] = v_beta, G + G_v @ v_beta
    return LinearSystem(A, E, np.concatenate((C_x + C_v @ v_x, C_v @ v_p), axis=2), C_v @ v_beta, V, H)
