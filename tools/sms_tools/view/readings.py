"""From blocks of samples to positions at display instants: each channel's last reading."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_online.pipeline.sensing import Sensing
from sms_online.stream import Array, Block

# Pictures of the arm a second of the session: smooth to the eye.
DISPLAY_RATE = 20.0


class Readings:
    """Turns blocks into measured positions x, one set for each 1/DISPLAY_RATE s of the session."""

    def __init__(self, sensing: Sensing, channels: tuple[str, ...]) -> None:
        self._sensing = sensing
        self._columns = [channels.index(name) for name in sensing.channels]
        self._last = np.full(len(self._columns), np.nan)
        self._shown = -np.inf  # number of the display interval of the last picture

    def push(self, block: Block) -> tuple[Array, Array]:
        """Instants (B,), s, and measured positions (B, n_x) due in this block; none before every channel has one."""
        values = block.values[:, self._columns]
        interval = np.floor(block.t * DISPLAY_RATE)
        due = np.flatnonzero(np.diff(interval, prepend=self._shown) > 0.0)
        if np.isnan(values).any():
            values = last_readings(values, self._last)
        self._last = values[-1]
        due = due[np.isfinite(values[due]).all(axis=1)]
        if due.size:
            self._shown = float(interval[due[-1]])
        return block.t[due], self._sensing.coordinates(values[due])


def last_readings(values: Array, before: Array) -> Array:
    """Values (B, C) with each NaN replaced by the channel's last number, `before` (C,) where the block has none."""
    stacked = np.concatenate((before[None], values))
    rows: NDArray[np.int64] = np.where(np.isnan(stacked), 0, np.arange(len(stacked))[:, None])
    return np.asarray(np.take_along_axis(stacked, np.maximum.accumulate(rows, axis=0), axis=0)[1:])
