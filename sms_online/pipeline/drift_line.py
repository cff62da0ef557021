"""What is known of a drift while rows are made: a line for each parameter that moves, straight or decaying.

What takes parameters for constant (the session's least squares, sums behind residuals, the detector of changes) gets
rows without the known part of the drift, that of the judged tracker's last estimate. Whitened rows are combinations of
windows at several times, in which a parameter that drifts was another: a ramp's own column, t Y and the first moment of
the test function, goes through the whitening with them, so that a ramp is removed exactly. So does that of a parabola,
for rates that decay: the whitening of a spacecraft's rows looks back for seconds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sms_online.stream import Array


@dataclass(frozen=True)
class DriftLine:
    """A line for each parameter that drifts.

    moved (n,): by how much parameters have moved at t, s, from a reference; rate (n,): per s, from there on.
    decay (n,): of the rates, 1/s. due: when a newer one is to take its place, s.
    """

    moved: Array
    rate: Array
    decay: Array
    t: float
    due: float

    def at(self, t: float) -> DriftLine:
        """The same at another instant."""
        time, decaying = t - self.t, self.decay > 0.0
        slowed = -np.expm1(-self.decay * time) / np.where(decaying, self.decay, 1.0)
        moved = self.moved + np.where(decaying, slowed, time) * self.rate
        return replace(self, moved=moved, rate=self.rate * np.exp(-self.decay * time), t=t)

    def from_now(self) -> DriftLine:
        """The same with what has moved counted from t on."""
        return replace(self, moved=np.zeros_like(self.moved))

    def padded(self, n: int) -> DriftLine:
        """The same of n parameters, of which further ones do not move."""
        moved, rate, decay = (np.pad(each, (0, n - each.size)) for each in (self.moved, self.rate, self.decay))
        return replace(self, moved=moved, rate=rate, decay=decay)

    def removed(self, rows: Array, ramp: Array, bend: Array | None = None) -> Array:
        """Rows [Y b] (…, n_v, n + 1) of a window centred at t as if nothing had moved.

        ramp, bend (n_v, n): what rates, and what their changes per s, add to b about t.
        """
        out = rows.copy()
        out[..., -1] -= rows[..., :-1] @ self.moved + ramp @ self.rate
        if bend is not None:
            out[..., -1] += bend @ (self.decay * self.rate)
        return out
