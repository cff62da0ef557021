"""What an effect is: a generalized force, linear in its coefficients; rows and energy column follow from it."""

from __future__ import annotations

from typing import Protocol

from sms_online.model.layout import Layout
from sms_online.model.parameters import Parameter
from sms_online.stream import Array


class ForceEffect(Protocol):
    """An effect of kind `force`, f(x, v) = Σ c_j f_j."""

    parameters: tuple[Parameter, ...]

    def force(self, layout: Layout, x: Array, v: Array) -> Array:
        """Columns f_j (B, n_v, coefficients): generalized force of one unit of each coefficient."""
