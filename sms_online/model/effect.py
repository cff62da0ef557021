"""What an effect has to be to enter a model: a generalized force linear in its coefficients, or inertia of a frame.

f(x, v, t) = Σ c_j f_j on the right-hand side of the equations of motion, d/dt(P π) - G π = Q + f.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sms_online.description.schema import System
from sms_online.model.chain import Chain
from sms_online.model.layout import Layout
from sms_online.model.parameters import Parameter
from sms_online.stream import Array


@dataclass(frozen=True)
class Inputs:
    """What an effect may need besides positions and speeds, at B instants.

    torque (B, inputs): n τ as measured, N m (N), then the components of measured wrenches, N and N m. states (B, n_z):
    internal states, to the model those of all effects in their order, to an effect its own.
    """

    torque: Array
    states: Array


class ForceEffect(Protocol):
    """An effect of kind `force`, with what a law without torques, internal states and shape constants has in common.

    parameters: the linear coefficients as they enter π. shapes: shape constants. relative_to: names of the model's
    parameters that reported coefficients are divided by. n_states: number of internal states. smooth: whether it is as
    smooth as the motion, which is thinned then. reversing: whether it jumps with the sign of a rate of its joint.
    dry: whether at a standstill it is any value up to that of its law. needs_masses: whether its columns hold reference
    masses of the model. A joint's force and internal states depend on that joint's positions, rates and torque.
    """

    name: str
    where: str
    parameters: tuple[Parameter, ...]
    shapes: Mapping[str, float]
    relative_to: tuple[str, ...]
    needs_torque: bool
    n_states: int
    smooth: bool
    reversing: bool
    dry: bool
    needs_masses: bool

    @property
    def key(self) -> str:
        """name@where."""
        return f"{self.name}@{self.where}"

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """Columns f_j (B, n_v, coefficients): generalized force of one unit of each coefficient."""

    def axis(self, layout: Layout) -> int:
        """Number of the speed whose sign the force follows; ValueError where it is neither reversing nor dry."""
        raise ValueError(f"{self.key} follows the sign of no rate")

    def power(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """Power (B, coefficients) that one unit of each coefficient takes out, W: -f · v."""
        return np.asarray(-np.einsum("bvn,bv->bn", self.force(layout, x, v, inputs), v))

    def beyond(self, layout: Layout, x: Array, v: Array) -> str:
        """Where a motion x (B, n_x), v (B, n_v) goes beyond what the force is known for; empty where it does not."""
        return ""

    def state_rate(self, layout: Layout, x: Array, v: Array, z: Array) -> Array:
        """ż (B, n_states) of the internal states z (B, n_states); zero without a law of its own."""
        return np.zeros_like(z)

    def initial_state(self, layout: Layout, x_0: Array) -> Array:
        """z (n_states,) at the start, at positions x_0 (n_x,) and rest; zero without a law of its own."""
        return np.zeros(self.n_states)

    def reported(self, values: Array) -> dict[str, float]:
        """The coefficients that a person reads, shape constants included, by name.

        values: of `parameters`, then of the parameters that `relative_to` names.
        """
        linear = {p.quantity: float(value) for p, value in zip(self.parameters, values, strict=True)}
        return linear | dict(self.shapes)


class InertiaEffect(Protocol):
    """An effect of kind `inertia`: a body in a frame of the chain, or one that turns with d speeds of its own.

    frame: number of the frame. speeds: those of its own. parameters: its coefficients as they enter π. matrices
    (c, 6 + d, 6 + d): inertia of one unit of each in the frame's axes, linear over angular, then by its own speeds.
    """

    frame: int
    speeds: slice
    parameters: tuple[Parameter, ...]
    matrices: Array


# Makes the effects that a system declares, of kinds force and inertia, for its chain and the weight of its masses:
# x (B, n_x) to the generalized forces (B, n_v, 2) of 1 m/s² of gravity along inertial x and y.
EffectsOf = Callable[
    [System, Chain, Callable[[Array], Array]], tuple[tuple[ForceEffect, ...], tuple[InertiaEffect, ...]]
]
