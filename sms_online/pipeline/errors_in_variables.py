"""What noise in the columns does to a least-squares estimate, measured by adding more of it.

Noise enters the columns too, and products square it: the expectation of YᵀY and of Yᵀb is off in second order, which
pulls the estimate. The same noise once more, added and subtracted, changes their mean by as much again, so that
2 YᵀY - ½ (Y₊ᵀY₊ + Y₋ᵀY₋) is free of it in second order. The first orders cancel in the pair.
Sources: Cook and Stefanski, J. American Statistical Association 89 (1994) 1314 (simulation extrapolation); Novick and
Stefanski, ibid. 97 (2002) 472 (corrected scores by simulation). The comparison of a consistent estimate with an
efficient one as an alarm: Hausman, Econometrica 46 (1978) 1251.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_online.stream import Array


class NoiseBias:
    """Gathers normal equations with and without additional noise."""

    def __init__(self, n: int) -> None:
        self._gram = np.zeros((n + 1, n + 1))
        self._excess = np.zeros((n + 1, n + 1))

    def add(self, rows: Array, noisy: Array) -> None:
        """Rows [Y b] (M, n + 1), and the same with noise added and subtracted (2, M, n + 1)."""
        gram = rows.T @ rows
        self._gram += gram
        self._excess += 0.5 * (noisy[0].T @ noisy[0] + noisy[1].T @ noisy[1]) - gram

    def shift(self, determined: NDArray[np.bool_]) -> Array:
        """What to add to the least-squares estimate (n,) to free it of this bias; zero where nothing is determined."""
        out = np.zeros(determined.size)
        kept = np.flatnonzero(determined)
        rows = np.append(kept, determined.size)
        size = np.sqrt(np.diag(self._gram)[rows])
        if kept.size == 0 or not (size > 0.0).all():
            return out
        gram, excess = (matrix[np.ix_(rows, rows)] / np.outer(size, size) for matrix in (self._gram, self._excess))
        biased = np.linalg.solve(gram[:-1, :-1], gram[:-1, -1])
        corrected = gram - excess
        out[kept] = (np.linalg.solve(corrected[:-1, :-1], corrected[:-1, -1]) - biased) * size[-1] / size[:-1]
        return out

    def state(self) -> dict[str, Array]:
        """What `restore` needs to continue."""
        return {"bias_gram": self._gram.copy(), "bias_excess": self._excess.copy()}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a saved state."""
        self._gram, self._excess = np.array(state["bias_gram"]), np.array(state["bias_excess"])
