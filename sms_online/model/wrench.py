"""Measured forces and moments of the surroundings: a generalized force whose coefficient is known to be one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sms_online.description.channels import WRENCH_COMPONENTS, wrench_components
from sms_online.description.schema import System
from sms_online.description.tree import BASE, index_of
from sms_online.model.chain import Chain
from sms_online.model.effect import ForceEffect, Inputs
from sms_online.model.layout import Layout
from sms_online.model.parameters import Parameter
from sms_online.stream import Array

# Nothing of it is left to estimate: `find_base_parameters` takes it as known.
GAIN = Parameter("wrench.gain", "w", "", 1.0)


class MeasuredWrenches(ForceEffect):
    """Σ Jᵀ w over the described wrenches, J the twist Jacobian of where each acts, in that body's axes there."""

    name, where = "wrench", "base"  # of a free base they change the momentum
    parameters: tuple[Parameter, ...] = (GAIN,)
    shapes: Mapping[str, float] = {}
    relative_to: tuple[str, ...] = ()
    needs_torque, n_states, needs_masses = True, 0, False
    smooth, reversing, dry = True, False, False

    def __init__(self, system: System, chain: Chain) -> None:
        self._chain = chain
        self._places = [
            (
                BASE if wrench.where == "base" else index_of(wrench.where),
                [WRENCH_COMPONENTS.index(name) for name in wrench_components(system, wrench)],
            )
            for wrench in system.wrenches
        ]

    def by_component(self, x: Array) -> Array:
        """Generalized forces (B, n_v, components) of one unit of each measured component."""
        ends = self._chain.configure(x).end_jacobians([place for place, _ in self._places])
        rows = [J[:, own] for J, (_, own) in zip(ends, self._places, strict=True)]
        return np.concatenate(rows, axis=1).swapaxes(1, 2)

    def force(self, layout: Layout, x: Array, v: Array, inputs: Inputs | None) -> Array:
        """See `ForceEffect`."""
        assert inputs is not None  # of an effect that needs them
        return self.by_component(x) @ inputs.torque[:, len(layout.q) :, None]

    def reported(self, values: Array) -> dict[str, float]:
        """Nothing: it is measured."""
        return {}
