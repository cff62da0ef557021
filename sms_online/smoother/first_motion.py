"""The motion that a span's search begins with: as the sensors alone give it, with its gaps filled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_online.model.model import Model
from sms_online.pipeline.sensing import Sensing
from sms_online.stream import Array

# A gap of the motion longer than this is filled, at this interval, s: 1 m/s moves the arm by a centimetre in it.
HOLE, FILL = 0.015, 0.01
# Samples within this time of an instant, s, say what a channel reads then.
NEARBY = 0.05


class FirstMotion:
    """Fills the gaps of a motion from those sensors that read something.

    channels: of the readings at hand.
    """

    def __init__(self, model: Model, sensing: Sensing, channels: Sequence[str]) -> None:
        self._layout, self._sensing, self._channels = model.layout, sensing, list(channels)

    def __call__(self, t: Array, motion: Array, sampled: Array, values: Array) -> tuple[Array, Array, Array]:
        """Instants, x and v of a motion with gaps, filled.

        What sensors do not show, as the shape of a link that cameras do not see, goes straight through a gap.
        t (B,), motion (B, n_x + n_v). sampled (M,), values (M, channels): of the readings.
        """
        layout = self._layout
        known = np.concatenate((sampled[:1], t, sampled[-1:]))
        fills = [np.arange(known[k] + FILL, known[k + 1], FILL) for k in np.flatnonzero(np.diff(known) > HOLE)]
        filled = []
        for fill in fills:
            around = np.concatenate((fill[:1] - FILL, fill, fill[-1:] + FILL))
            x = self._sensing.coordinates(self._read(around, sampled, values))
            straight = np.stack([np.interp(around, t, column) for column in motion.T[: layout.n_x]], axis=1)
            x = np.where(np.isfinite(x), x, straight)
            v = layout.speeds(x, np.gradient(x, around, axis=0))
            filled.append(np.concatenate((x, v), axis=1)[1:-1])
        times = np.concatenate((t, *fills))
        order = np.argsort(times, kind="stable")
        whole = np.concatenate((motion, *filled))[order]
        return times[order], whole[:, : layout.n_x], whole[:, layout.n_x :]

    def _read(self, t: Array, sampled: Array, values: Array) -> Array:
        """Readings (B, sensing's channels) at t (B,), s, between samples; NaN where there are none nearby."""
        out = np.full((t.size, len(self._sensing.channels)), np.nan)
        for column, name in enumerate(self._sensing.channels):
            own = values[:, self._channels.index(name)] if name in self._channels else np.empty(0)
            read = np.flatnonzero(np.isfinite(own))
            if read.size:
                at = sampled[read]
                out[:, column] = np.interp(t, at, own[read])
                after = np.searchsorted(at, t).clip(0, read.size - 1)
                apart = np.minimum(np.abs(at[after] - t), np.abs(at[np.maximum(after - 1, 0)] - t))
                out[apart > NEARBY, column] = np.nan
        return out
