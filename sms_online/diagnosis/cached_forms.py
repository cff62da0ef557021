"""Quadratic forms of a law's coefficients, evaluated once for each law that a search asks for again and again."""

from __future__ import annotations

from collections.abc import Callable, Hashable

import numpy as np

from sms_online.stream import Array


class CachedForms:
    """Remembers forms by key: values at unit vectors and at sums of two determine a quadratic form."""

    def __init__(self) -> None:
        self._known: dict[Hashable, tuple[list[Array], dict[tuple[int, int], Array]]] = {}

    def at(self, key: Hashable, form: Callable[[Array], Array], coefficients: Array) -> Array:
        """The form's value, never negative, at some coefficients (c,)."""
        unit = np.eye(coefficients.size)
        if key not in self._known:
            own = [form(vector) for vector in unit]
            pairs = [(i, j) for j in range(len(own)) for i in range(j)]
            self._known[key] = own, {(i, j): form(unit[i] + unit[j]) - own[i] - own[j] for i, j in pairs}
        own, mixed = self._known[key]
        squares = sum(c**2 * value for c, value in zip(coefficients.tolist(), own, strict=True))
        products = sum(coefficients[i] * coefficients[j] * value for (i, j), value in mixed.items())
        return np.asarray(np.maximum(0.0, squares + products))
