"""Quadratic forms are evaluated once for each law, and right for any coefficients."""

from __future__ import annotations

import numpy as np

from sms_online.diagnosis.cached_forms import CachedForms
from sms_online.stream import Array


def test_a_form_is_evaluated_at_unit_vectors_and_sums_alone() -> None:
    rng = np.random.default_rng(2)
    factors = rng.standard_normal((7, 5, 3))
    asked: list[Array] = []

    def form(coefficients: Array) -> Array:
        asked.append(coefficients)
        return np.asarray(np.sum((factors @ coefficients) ** 2, axis=1))

    forms = CachedForms()
    for coefficients in rng.standard_normal((10, 3)):
        expected = np.sum((factors @ coefficients) ** 2, axis=1)
        np.testing.assert_allclose(forms.at("law", form, coefficients), expected, rtol=1e-12)
    assert len(asked) == 6
    forms.at("another law", form, np.ones(3))
    assert len(asked) == 12
