"""Springs and dampers between coordinates: quadratic forms, one a parameter, (14), (23), (24)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_online.stream import Array


@dataclass(frozen=True)
class Spring:
    """A quadratic potential ½ c zᵀ S z of some coordinates z, or a damper of their rates."""

    parameter: int
    speeds: slice | list[int]
    matrix: Array

    def add_to(self, full: Array, factor: float) -> None:
        """Add `factor` S to an (n_v, n_v) matrix."""
        columns = np.arange(full.shape[0])[self.speeds]
        full[np.ix_(columns, columns)] += factor * self.matrix


class QuadraticForms:
    """Several springs (or dampers) at once: ½ zᵀ S z of each is linear in the products of coordinates."""

    def __init__(self, springs: list[Spring], n_v: int) -> None:
        self.parameters = [spring.parameter for spring in springs]
        full = np.zeros((len(springs), n_v, n_v))
        for matrix, spring in zip(full, springs, strict=True):
            spring.add_to(matrix, 0.5)
        # Products that occur in none of them are left out.
        self._first, self._second = np.nonzero(np.any(full != 0.0, axis=0))
        self._weights = full[:, self._first, self._second].T

    def energies(self, z: Array) -> Array:
        """½ zᵀ S z (B, springs) for all coordinates in the order of the speeds (B, n_v)."""
        return np.asarray((z[:, self._first] * z[:, self._second]) @ self._weights)
