"""Grid samples that wait for something, saved with a session."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_online.pipeline.synchronise import GridSamples


def waiting_state(name: str, waiting: Sequence[GridSamples], columns: int) -> dict[str, Any]:
    """Pieces of samples (B, columns), as arrays to be saved under names that begin with `name`."""
    return {
        f"{name}_index": np.concatenate([np.empty(0, dtype=np.int64), *(piece.index for piece in waiting)]),
        f"{name}_values": np.concatenate([np.empty((0, columns)), *(piece.values for piece in waiting)]),
        f"{name}_segments": np.repeat([piece.segment for piece in waiting], [piece.index.size for piece in waiting]),
    }


def waiting_from_state(name: str, state: Mapping[str, NDArray[Any]]) -> list[GridSamples]:
    """The samples that `waiting_state` saved, a piece for each segment."""
    index, values, segments = (np.array(state[f"{name}_{part}"]) for part in ("index", "values", "segments"))
    return [GridSamples(index[segments == k], values[segments == k], int(k)) for k in np.unique(segments)]
