"""Sensors that are so late that no parameters fit the motion they measure, found before any force is looked for.

Rows without a torque say that what springs are measured to pull is what moves the masses behind them, whatever friction
the motors have. They are homogeneous in π: against a sensor that is far behind the others, least squares shrinks masses
and stiffness together to nothing, and every candidate beside them seems idle. So each stiffness is asked apart: the
share of its column that no masses can follow, over windows that were not fitted. A sensor is late where readings
without its lag bring that share down as nothing else would.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np
from scipy.optimize import minimize_scalar

from sms_online.description.schema import Effect
from sms_online.diagnosis.candidates import CandidateColumns
from sms_online.diagnosis.constants import corrected
from sms_online.diagnosis.evidence import RANK_TOLERANCE, threshold
from sms_online.diagnosis.folds import Folds
from sms_online.diagnosis.record import Segment
from sms_online.diagnosis.rows import SessionRows
from sms_online.diagnosis.weak_windows import Motion, WeakWindows
from sms_online.effects.catalogue import lag_places
from sms_online.effects.delay import LONGEST_FOUND, delay_of, lag, late_keys
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.stream import Array

# Corners that are tried first, Hz, from that of the longest delay on; quicker lags are found to first order in their
# delay, beside the forces.
CORNERS = (delay_of(LONGEST_FOUND), 2.0, 3.5, 6.0)
# Where masses follow the springs to this share none of these corners is in any sensor: 6 Hz would leave 5 % at least.
FOLLOWED = 0.02
# A sensor is late where its lag leaves less than this share of what no masses can follow.
LARGEST_LEFT = 0.5
# Probability that any sensor seems late by accident.
FALSE_ALARM = 0.01
# Lags whose gain differs by less than this share are not distinguished.
SAME_SHARE = 0.03
# Accuracy of the logarithm of a corner, and evaluations at most.
TOLERANCE, EVALUATIONS = 3e-3, 15
# Step of the logarithm of a corner that shows how sharp its optimum is.
SHARPNESS_STEP = 0.05
# One block in so many checks what the others say.
CHECKED = 3
# Windows in a row that are asked, of three times as many: a sensor that is so late shows everywhere.
STRETCH = 3 * HOPS
STIFFNESS = ("stiffness", "flexural_rigidity", "flexural_rigidity_y", "flexural_rigidity_z", "torsional_rigidity")
# A column acts on rows that hold this share of its squares at least.
ACTS = 0.01


@dataclass(frozen=True)
class LateSensor:
    """A lag that was found.

    effect: with its corner; std: of the corner, Hz. gain: twice the logarithm of the likelihood ratio; limit: what the
    best of all would reach by accident. before, after: share of the springs' columns that no masses can follow, rms
    over the springs, of windows that were not fitted. ambiguous: places whose lag would gain nearly as much.
    """

    effect: Effect
    std: float
    gain: float
    limit: float
    before: float
    after: float
    ambiguous: tuple[str, ...]

    @property
    def corner(self) -> float:
        """Of the lag, Hz."""
        return self.effect.coefficients["corner"]

    @property
    def improvement(self) -> float:
        """Share of what no masses could follow that is gone."""
        return 1.0 - self.after / self.before


class Motions:
    """Asks how well the masses can follow the springs, for readings with a lag taken off."""

    def __init__(self, rows: SessionRows, make: CandidateColumns, folds: Folds) -> None:
        fitted = folds.block % CHECKED != CHECKED - 1
        some = np.arange(rows.count) // STRETCH % 3 == 0
        if min(np.count_nonzero(fitted[some]), np.count_nonzero(~fitted[some])) < STRETCH:
            some = np.ones(rows.count, dtype=bool)
        self._rows, self._make, self._fitted = rows, make, fitted[some]
        self._channels = rows.sensing.channels
        model = rows.model
        known = {p.name for p in model.parameters} & set(model.system.known)
        # One filter for all windows: that many fewer smoothed motions for each lag that is tried.
        windows = rows.weak.windows
        middle = np.sort(windows.half_width)[rows.count // 2]
        self._windows = replace(
            windows,
            segment=windows.segment[some],
            start=windows.start[some],
            half_width=np.full(np.count_nonzero(some), middle),
        )
        self._springs = [k for k, p in enumerate(model.parameters) if p.quantity in STIFFNESS]
        self._masses = [k for k, p in enumerate(model.parameters) if k not in self._springs and p.name not in known]
        self._still = [v for v in range(model.layout.n_v) if v not in model.layout.theta_m]

    @property
    def asked(self) -> bool:
        """Whether there are rows without a torque that hold a spring."""
        return bool(self._springs and self._still)

    def places(self) -> list[str]:
        """Groups of sensors that may be late together."""
        readings = [self._channels[k] for k in self._rows.sensing.position_columns]
        lags = lag_places(self._rows.model.system)
        return [where for where in lags if any(fnmatchcase(name, where) for name in readings)]

    def unfollowed(self, where: str | None = None, corner: float = np.inf) -> tuple[float, float]:
        """Share of the springs' columns that no masses follow, rms, in windows that were fitted and in the others."""
        segments = list(self._rows.segments)
        if where is not None:
            segments = [self._without(where, corner, segment) for segment in segments]
        model, rows = self._rows.model, self._rows
        weak = WeakWindows(self._windows, model.layout, rows.sensing, segments, model.system.sample_rate)

        def columns(motion: Motion) -> tuple[Array, Array]:
            return model.momentum_columns(motion.x, motion.v, self._still, self._make.inputs(motion))

        Y = weak.columns(columns)
        shares = []
        for spring in self._springs:
            squares = np.sum(Y[..., spring] ** 2, axis=0)
            acts = squares > ACTS * squares.max()
            shares.append(self._share(Y[:, acts], spring))
        fit, held = np.sqrt(np.mean(np.square(shares), axis=0))
        return float(fit), float(held)

    def _without(self, where: str, corner: float, segment: Segment) -> Segment:
        """The samples of a segment with one lag more taken off."""
        lagging = self._rows.model.system.model_copy(update={"effects": (lag(where, corner),)})
        return corrected(lagging, self._channels, segment)

    def _share(self, Y: Array, spring: int) -> tuple[float, float]:
        """Of one spring's column in its rows (W, rows, n_pi)."""
        pulled, moved = Y[..., spring], Y[..., [k for k in (*self._springs, *self._masses) if k != spring]]
        fitted = self._fitted
        A, b = moved[fitted].reshape(-1, moved.shape[2]), pulled[fitted].ravel()
        size = np.linalg.norm(A, axis=0)
        size[size == 0.0] = 1.0
        c = np.linalg.lstsq(A / size, b, rcond=RANK_TOLERANCE)[0] / size
        left = pulled - moved @ c
        return tuple(
            float(np.linalg.norm(left[part]) / max(np.linalg.norm(pulled[part]), np.finfo(np.float64).tiny))
            for part in (fitted, ~fitted)
        )  # type: ignore[return-value]

    def gain(self, before: float, after: float) -> float:
        """Twice the logarithm of the likelihood ratio of two shares, rows of windows that do not overlap counted."""
        independent = np.count_nonzero(self._fitted) / HOPS * len(self._springs)
        return float(2.0 * independent * np.log(before / max(after, np.finfo(np.float64).tiny)))


def find_late(rows: SessionRows, make: CandidateColumns, folds: Folds) -> LateSensor | None:
    """The sensors whose lag, taken off, lets the masses follow the springs; None where no lag does so.

    make: gives what declared effects need along a motion. folds: blocks of the windows, one in
    CHECKED of which checks the others.
    """
    motions = Motions(rows, make, folds)
    places = motions.places() if motions.asked else []
    if not places:
        return None
    fit, held = motions.unfollowed()
    if max(fit, held) < FOLLOWED:
        return None
    tried = [(motions.unfollowed(where, corner)[0], where, corner) for where in places for corner in CORNERS]
    best, where, corner = min(tried)
    limit = threshold(FALSE_ALARM, len(tried), 1)
    if motions.gain(fit, best) < limit:
        return None
    corner = _refined(motions, where, corner)
    best, after = motions.unfollowed(where, corner)
    if after > LARGEST_LEFT * held:
        return None
    gain = motions.gain(fit, best)
    alike = dict.fromkeys(
        other for share, other, _ in tried if other != where and motions.gain(fit, share) > (1.0 - SAME_SHARE) * gain
    )
    std = _std(motions, where, corner, best)
    return LateSensor(lag(where, corner), std, gain, limit, held, after, tuple(late_keys((), alike)))


def _refined(motions: Motions, where: str, corner: float) -> float:
    """The corner between those tried before at which the masses follow best."""
    here = CORNERS.index(corner)
    low = CORNERS[max(0, here - 1)]
    high = CORNERS[here + 1] if here + 1 < len(CORNERS) else corner**2 / CORNERS[here - 1]
    result = minimize_scalar(
        lambda log_corner: motions.unfollowed(where, float(np.exp(log_corner)))[0],
        bounds=(float(np.log(low)), float(np.log(high))),
        method="bounded",
        options={"xatol": TOLERANCE, "maxiter": EVALUATIONS},
    )
    return float(np.exp(result.x))


def _std(motions: Motions, where: str, corner: float, best: float) -> float:
    """1σ of the corner, Hz, from the curvature of twice the log likelihood over the logarithm of the corner."""
    sides: Sequence[float] = [
        motions.gain(motions.unfollowed(where, corner * float(np.exp(step)))[0], best)
        for step in (SHARPNESS_STEP, -SHARPNESS_STEP)
    ]
    curvature = sum(sides) / SHARPNESS_STEP**2
    return corner * float(np.sqrt(2.0 / curvature)) if curvature > 0.0 else np.inf
