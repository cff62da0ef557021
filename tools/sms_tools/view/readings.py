"""From blocks of samples to what is seen of the arm: each channel's last reading, and positions at display instants."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.pipeline.sensing import Sensing
from sms_online.stream import Array, Block, Indices

# Pictures of the arm a second of the session: smooth to the eye.
DISPLAY_RATE = 20.0


class SampleAndHold:
    """Last reading (C,) of some channels, NaN before the first. names: theirs. channels: of the blocks."""

    def __init__(self, names: Sequence[str], channels: Sequence[str]) -> None:
        self._columns = [channels.index(name) for name in names]
        self.last = np.full(len(names), np.nan)

    def push(self, block: Block) -> Array:
        """The last readings (B, C) at each instant of a block."""
        values = block.values[:, self._columns]
        if np.isnan(values).any():
            stacked = np.concatenate((self.last[None], values))
            rows: Indices = np.where(np.isnan(stacked), 0, np.arange(len(stacked))[:, None])
            values = np.take_along_axis(stacked, np.maximum.accumulate(rows, axis=0), axis=0)[1:]
        self.last = values[-1]
        return values


class Readings:
    """Turns blocks into measured positions x, one set for each 1/DISPLAY_RATE s of the session."""

    def __init__(self, sensing: Sensing, channels: tuple[str, ...]) -> None:
        self._sensing = sensing
        self._held = SampleAndHold(sensing.channels, channels)
        self._shown = -np.inf  # number of the display interval of the last picture

    def push(self, block: Block) -> tuple[Array, Array]:
        """Instants (B,), s, and measured positions (B, n_x) due in this block; none before every channel has one."""
        values = self._held.push(block)
        interval = np.floor(block.t * DISPLAY_RATE)
        due = np.flatnonzero(np.diff(interval, prepend=self._shown) > 0.0)
        due = due[np.isfinite(values[due]).all(axis=1)]
        if due.size:
            self._shown = float(interval[due[-1]])
        return block.t[due], self._sensing.coordinates(values[due])
