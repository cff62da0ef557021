"""Axes of plots without true values: about the estimates themselves, as far as their error bars reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sms_online.stream import Mask
from sms_tools.view.frames import Reference
from sms_tools.view.known import BOUNDS, Known
from sms_tools.view.parameter_groups import HALF_RANGES, Basis, half_range

# An axis reaches so many times as far as the error bars: estimates move within them.
ROOM = 2.0
# Bars this many times shorter than their axis has room for get a new one: a viewer whose layout is changed
# forgets what a person has changed in it.
SHRUNK = 10.0
# For the same reason, and because what has been drawn is drawn again, an axis stays for so long at least, s, and for
# this share of the session so far.
LEAST_REST, REST = 2.0, 0.25


class OwnScale:
    """What estimates without a true value are compared with: first nominal values, then the estimates of some instant.

    basis: the one that holds, see `Basis`. Its values are filled in for what is determined later.
    """

    def __init__(self, references: Sequence[Reference | None]) -> None:
        self._compared: Mask = np.array([r is None or not r.is_true for r in references], dtype=bool)
        nominal = [np.nan if r is None or r.is_true else r.value or np.nan for r in references]
        self.basis = Basis(np.array(nominal), "nominal value", HALF_RANGES[-1])
        self._own = False
        self._begun, self._due = np.inf, -np.inf  # s

    def follow(self, now: Known, converged: bool, last: bool = False) -> bool:
        """Take in what is known now; whether there is another basis for it.

        converged: the estimate moves within its error bars. last: of the session.
        """
        t, estimate = now.t, now.estimate
        more = estimate.size - self._compared.size
        if more > 0:
            # An event has added parameters.
            self._compared = np.append(self._compared, np.ones(more, dtype=bool))
            about = np.append(self.basis.about, np.full(more, np.nan))
            self.basis = Basis(about, self.basis.name, self.basis.half_range)
        basis = self.basis
        drawn = now.determined & self._compared & (estimate != 0.0)
        known = np.where(drawn, estimate, np.nan)
        self._begun = min(self._begun, t)
        if drawn.any() and (last or (converged and t >= self._due)):
            bars = 100.0 * BOUNDS * now.std / np.abs(known)
            wanted = half_range(ROOM * bars)
            shrunk = wanted * SHRUNK <= basis.half_range
            beyond = half_range(100.0 * np.abs(known / basis.about - 1.0) + bars) > basis.half_range
            if last or not self._own or shrunk or beyond:
                self.basis = Basis(known, f"estimate at {t:.1f} s", wanted)
                self._own = True
                self._due = t + max(LEAST_REST, REST * (t - self._begun))
                return True
        if self._own:
            fresh = np.isnan(basis.about) & drawn
            if fresh.any() and t >= self._due:
                self.basis = replace(basis, about=np.where(fresh, known, basis.about))
                self._due = t + max(LEAST_REST, REST * (t - self._begun))
                return True
        return False
