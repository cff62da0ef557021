"""Symmetric matrices by their upper triangle, as they are kept and written."""

from __future__ import annotations

import math

import numpy as np

from sms_online.stream import Array


def upper(matrix: Array) -> Array:
    """Upper triangle (n (n + 1) / 2,) of a matrix (n, n), row by row."""
    return np.asarray(matrix[np.triu_indices(len(matrix))])


def symmetric(triangle: Array) -> Array:
    """The matrices (..., n, n) of upper triangles (..., n (n + 1) / 2)."""
    n = (math.isqrt(8 * triangle.shape[-1] + 1) - 1) // 2
    i, j = np.triu_indices(n)
    out = np.empty((*triangle.shape[:-1], n, n))
    out[..., i, j] = out[..., j, i] = triangle
    return out
