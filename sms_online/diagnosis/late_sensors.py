"""Sensors that are so late that no parameters fit the motion they measure, found before any force is looked for.

Against a sensor that is far behind the others no masses follow the springs, and every candidate beside them seems idle.
So lags are compared by how well readings without them can be explained at all: by a rough fit, which allows for
friction at every joint and is invariant to the scale of rows without a torque. A sensor is late where that leaves less
of windows that it was not fitted to than without it, all types of rows together, and more than chance would: a short
capture has hardly more windows than there are parameters, and fits itself with any lag.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np
from scipy.optimize import minimize_scalar

from sms_online.description.channels import concerns
from sms_online.description.schema import Effect
from sms_online.diagnosis.constants import corrected
from sms_online.diagnosis.evidence import threshold
from sms_online.diagnosis.record import Segment
from sms_online.diagnosis.rough_fit import HALVES, RoughRows, stretches
from sms_online.diagnosis.rows import SessionRows
from sms_online.effects.catalogue import lag_places
from sms_online.effects.delay import HELD, LONGEST_FOUND, delay_of, lag, lagging, late_keys
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array

# Corners that are tried first, Hz, from that of the longest delay to that of 3 ms; rows of a stiff spring show no more
# than that it is late by a factor of three.
CORNERS = (delay_of(LONGEST_FOUND), 2.0, 3.5, 6.0, delay_of(0.01), delay_of(0.003))
# A lag takes this share of what is left at least, as any effect.
LEAST_IMPROVEMENT = 0.1
# Probability that any sensor seems late by accident.
FALSE_ALARM = 0.01
# Lags are tried on part of a session; those that gain there at least this share of what the best does are tried on all
# of it, so many at most.
NEAR_BEST, MOST_NEAR = 0.5, 8
# Lags whose gain differs by less than this share are not distinguished.
SAME_SHARE = 0.03
# One sensor of a group is late alone where that gains more than its whole group does by this factor.
ALONE = 1.25
# Accuracy of the logarithm of a corner, and evaluations at most.
TOLERANCE, EVALUATIONS = 1e-2, 10
# Step of the logarithm of a corner that shows how sharp its optimum is.
SHARPNESS_STEP = 0.05
# Blocks of windows, and parts that these make up, each predicted from the others.
BLOCKS, PARTS = 9, 3
# Standard deviations that a corner is from zero at least: what windows leave depends on it.
DETERMINED = 3.0
# Of rows that leave less than this share nothing is left. Of those that leave more than all nothing is explained.
TINY = 1e-3


@dataclass(frozen=True)
class LateSensor:
    """A lag that was found.

    effect: with its corner; std: of the corner, Hz. gain: twice the logarithm of the likelihood ratio; limit: what the
    best of all would reach by accident. before, after: share that is left of rows that were not fitted, geometric mean
    over their types. ambiguous: places whose lag would gain nearly as much.
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
        """Share of what was left that is gone."""
        return 1.0 - self.after / self.before


class Lags:
    """Asks how well readings can be explained with a lag taken off; rows: model and sensors, segments: samples."""

    def __init__(self, rows: Estimator | SessionRows, segments: Sequence[Segment]) -> None:
        self._rows, self._segments = rows, list(segments)
        self._independent = 0
        self._left: dict[tuple[str | None, float], Array] = {}

    def places(self) -> dict[str, list[str]]:
        """Groups of sensors that may be late together, and sensors of no group; to each the parts of a group."""
        readings = [self._rows.sensing.channels[k] for k in self._rows.sensing.position_columns]
        matching = {
            where: {name for name in readings if fnmatchcase(name, where)}
            for where in lag_places(self._rows.model.system)
        }
        lags = lagging(self._rows.model.system.effects)
        late = {name for name in readings if any(fnmatchcase(name, where) for where in lags)}
        own = {where: names for where, names in matching.items() if names}
        return {
            where: [other for other, part in own.items() if part < names]
            for where, names in own.items()
            if not names & late and (len(names) > 1 or not any(names < others for others in own.values()))
        }

    def left(self, where: str | None = None, corner: float = np.inf) -> Array:
        """Logarithms (types,) of what is left of each type of rows, windows predicted from the others.

        Without a lag unless where is given. Infinite where readings are of no shape of the links.
        """
        if (where, corner) not in self._left:
            self._left[where, corner] = self._predicted(where, corner)
        return self._left[where, corner]

    def _predicted(self, where: str | None, corner: float) -> Array:
        """See `left`."""
        segments = self._segments
        if where is not None:
            # The samples are free of what is declared, latencies of sensors included.
            late = self._rows.model.system.model_copy(update={"effects": (lag(where, corner),), "sensors": ()})
            segments = [corrected(late, self._rows.sensing.channels, segment) for segment in segments]
        try:
            rough = RoughRows(self._rows, segments)
        except np.linalg.LinAlgError:
            return np.full(1, np.inf)
        part = np.arange(rough.count) * BLOCKS // rough.count % PARTS
        shares = [rough.shares(part != k) for k in range(PARTS)]
        self._independent = rough.count // HALVES
        return np.asarray(np.log(np.clip(np.sqrt(np.mean(np.square(shares), axis=0)), TINY, 1.0)))

    def gains(self, before: Array, after: Array) -> Array:
        """Twice the logarithms (types,) of likelihood ratios of what is left, windows that do not overlap counted."""
        return np.asarray(2.0 * self._independent * (before - after))


def find_late(rows: SessionRows, without: Sequence[str] = ()) -> LateSensor | None:
    """The sensors whose lag, taken off, lets the rows be explained better; None where no lag does so.

    without: channels that no sensor reads.
    """
    lags = Lags(rows, rows.segments)
    places = {where: parts for where, parts in lags.places().items() if not concerns(where, without)}
    if not places:
        return None
    before = lags.left()
    if not np.all(np.isfinite(before)):
        return None
    # A drive that holds its command over a sample acts half a sample late.
    least = HELD / rows.model.system.sample_rate
    corners = [corner for corner in CORNERS if delay_of(corner) > least]
    limit = threshold(FALSE_ALARM, len(places) * len(corners), 1)
    some = stretches(rows, rows.segments)
    part = sum(each.index.size for each in some) < sum(each.index.size for each in rows.segments)
    near = _near_best(Lags(rows, some) if part else lags, list(places), corners, limit)
    tried = [(lags.left(where, corner), where, corner) for where, corner in near]
    # A lag that is none leaves some types of rows with less and others with more.
    tried = [each for each in tried if lags.gains(before, each[0]).min() > -limit]
    best, where, corner = min(tried, key=lambda each: each[0].sum(), default=(before, "", np.inf))
    if lags.gains(before, best).sum() <= limit:
        return None
    corner = _refined(lags, where, corner)
    after = lags.left(where, corner)
    if delay_of(corner) <= least or after.mean() > before.mean() + np.log(1.0 - LEAST_IMPROVEMENT):
        return None
    gain = lags.gains(before, after).sum()
    parts = [(lags.left(part, corner), part) for part in places[where]]
    if parts and lags.gains(before, (alone := min(parts, key=lambda each: each[0].sum()))[0]).sum() > ALONE * gain:
        after, where = alone
        gain = lags.gains(before, after).sum()
    others = [(left, other) for left, other, _ in tried] + parts
    same = (1.0 - SAME_SHARE) * gain
    alike = dict.fromkeys(o for left, o in others if o != where and lags.gains(before, left).sum() > same)
    std = _std(lags, where, corner, after)
    if std > corner / DETERMINED:
        return None
    shares = float(np.exp(before.mean())), float(np.exp(after.mean()))
    return LateSensor(lag(where, corner), std, float(gain), limit, *shares, tuple(late_keys((), alike)))


def _near_best(lags: Lags, places: Sequence[str], corners: Sequence[float], limit: float) -> list[tuple[str, float]]:
    """Lags (place, corner) that gain nearly as much as the best does.

    limit: what gains by accident, or loses. Where a short lag loses more, a longer one of that place does too.
    """
    before = lags.left()
    if not np.all(np.isfinite(before)):
        return [(where, corner) for where in places for corner in corners]
    gains: dict[tuple[str, float], float] = {}
    for where in places:
        for corner in sorted(corners, key=delay_of):
            gained = lags.gains(before, lags.left(where, corner))
            gains[where, corner] = float(gained.sum()) if gained.min() > -limit else -np.inf
            if gained.sum() < -limit:
                break
    most = max(0.0, NEAR_BEST * max(gains.values()))
    near = sorted((each for each in gains if gains[each] > most), key=lambda each: -gains[each])
    return near[:MOST_NEAR]


def _refined(lags: Lags, where: str, corner: float) -> float:
    """The corner between those tried before that leaves least."""
    here = CORNERS.index(corner)
    low = CORNERS[max(0, here - 1)]
    high = CORNERS[here + 1] if here + 1 < len(CORNERS) else corner**2 / CORNERS[here - 1]
    result = minimize_scalar(
        lambda log_corner: float(lags.left(where, float(np.exp(log_corner))).sum()),
        bounds=(float(np.log(low)), float(np.log(high))),
        method="bounded",
        options={"xatol": TOLERANCE, "maxiter": EVALUATIONS},
    )
    return float(np.exp(result.x))


def _std(lags: Lags, where: str, corner: float, best: Array) -> float:
    """1σ of the corner, Hz, from the curvature of twice the log likelihood over the logarithm of the corner."""
    sides = [
        lags.gains(lags.left(where, corner * float(np.exp(step))), best).sum()
        for step in (SHARPNESS_STEP, -SHARPNESS_STEP)
    ]
    curvature = sum(sides) / SHARPNESS_STEP**2
    return corner * float(np.sqrt(2.0 / curvature)) if curvature > 0.0 else np.inf
