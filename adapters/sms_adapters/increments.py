"""Steps from one sample to the next, which a live session takes some thousand times a second."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", np.float64, np.int64)


def increments(values: NDArray[Number], before: float | NDArray[Number]) -> NDArray[Number]:
    """values (M, …) less the ones before them along the first axis; `before` comes before the first.

    As numpy.diff with prepend, at a fifth of its cost for a few values.
    """
    out = values.copy()
    if len(out):
        out[1:] -= values[:-1]
        out[:1] -= before  # type: ignore[arg-type]  # of the same kind as the values
    return out
