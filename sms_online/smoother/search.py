"""The way of a search on one span: from loose equations of motion to exact ones, or to those that samples allow."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass

import numpy as np

from sms_online.smoother.averaging import FEWEST_TARGETS, LONGEST_MISFIT, LONGEST_STEP, averaged
from sms_online.smoother.gauss_newton import EVERY_NODE, NO_NUMBERS, DivergedError, GaussNewton
from sms_online.smoother.span import Ending
from sms_online.stream import Array
from sms_online.trackers.factor import solve, triangular_factor

# Steps of the collocation are ever finer until that changes no parameter by more than so many standard deviations: the
# error of the last one is a sixteenth of that change, as its order is four.
REFINED = 1.0
# Those that are allowed for where the samples refute exact equations; more than that is another system.
ALLOWED = (0.001, 0.003, 0.01, 0.03)
# Before them, times the noise that samples of the torques show: coloured noise, ripple, and friction that follows no
# law act beside the torques, and leave the equations of all other coordinates exact. So many times at most, and each
# time by so much more at least and at most; by as much where it is not known how much is lacking. Far too much of it
# would leave the scale of all parameters to the noise of the positions, so a little more than noise may be left.
MOST_TORQUE_NOISE, LEAST_RISE, MOST_RISE, UNKNOWN_RISE = 100.0, 1.5, 10.0, 3.0
LITTLE_MORE = 1.5
# A level is tried again while the innovations are larger than noise makes them, so often at most.
MOST_TRIES = 3
# Share by which mean squares of one minimum differ at most.
SAME = 0.01
# Share of the mean square that steps of half the length leave, at most, where it is those that are too long.
OF_STEPS = 0.5
# A step of the search that moves no parameter by more standard deviations than this ends it: the next one would be
# smaller by far, as the convergence is quadratic near the end.
CONVERGED = 0.5
MAX_STEPS = 16
# So does a mean square beyond LARGEST_MISFIT that changes by less than this share in so many steps: no parameters meet
# the samples, and friction's corners keep these moving.
STILL, STILL_STEPS = 1e-4, 3
# Mean square of the whitened innovations that noise alone may leave: a span of some seconds scatters by a hundredth,
# the noise behind it is estimated to a tenth.
LARGEST_MEAN_SQUARE = 1.2
# Mean square up to which exact equations are kept: friction that follows its law roughly leaves twice the noise. Beside
# noise of the torques that would explain it, the scale of all parameters would be uncertain.
LARGEST_MISFIT = 4.0
# And from which on equations refute what is known, if a further step of the motion does not take it to less than half:
# parameters whose exact equations leave little but noise will not be met.
REFUTED, HALF = 100.0, 0.5


@dataclass(frozen=True)
class SpanFit:
    """The information of a span at its end: a factor (n + 1, n + 1) of rows Y β = b with independent unit errors.

    beta (n,): estimate from this span and what was known before it. rows: how many innovations. mean_square: of the
    whitened innovations. level: of the white forces that are left, 0 where the equations hold. torque_noise: times what
    samples show of it. step: of the collocation, s. ending: last state.
    """

    factor: Array
    beta: Array
    rows: int
    mean_square: float
    level: float
    torque_noise: float
    step: float
    ending: Ending

    @property
    def inexact(self) -> tuple[float, float]:
        """How far from exact the equations are, to compare fits by."""
        return self.level, self.torque_noise

    def is_minimum_of(self, other: SpanFit) -> bool:
        """Whether another fit, from another start, has met the same minimum, and allows for as much."""
        as_much = self.level == other.level and abs(self.torque_noise - other.torque_noise) < SAME * other.torque_noise
        return as_much and _near(self.factor, self.beta - other.beta, 1.0)


class Search(GaussNewton):
    """A search that goes on until β converges, with steps of the collocation as fine as that asks for."""

    def through(self, levels: Sequence[float], steps: Sequence[float], exactly: bool = False) -> SpanFit:
        """The fit, by way of white forces of so many levels, with equations that hold as well as the samples allow.

        exactly: they are to leave no more than noise; else DivergedError.
        """
        if (fit := self.exact(levels, steps, exactly)) is not None:
            return fit
        if exactly:
            raise DivergedError("samples do not agree with the equations of motion")
        return self.allowing()

    def exact(self, levels: Sequence[float], steps: Sequence[float], strictly: bool = False) -> SpanFit | None:
        """The fit with equations that hold, None where samples do not agree with any; see `through`.

        strictly: it is to converge to one β, and to leave no more than noise.
        """
        for level in levels:
            self.loosen(level)
            while strictly and self.mean_square > REFUTED:
                left = self.mean_square
                self.advance(level)
                if self.mean_square > HALF * left:
                    return None
        for k, step in enumerate(steps):
            self.refine(step)
            before, left = self.beta, self.mean_square
            if not self.converge(0.0, strictly=strictly):
                break
            if k and self.mean_square > max(LARGEST_MISFIT, OF_STEPS * left):
                break
            if k and np.all(np.abs(self.beta - before) <= REFINED * self.std):
                break
        fits = self.mean_square <= (LARGEST_MEAN_SQUARE if strictly else LARGEST_MISFIT)
        return self._taken(0.0) if fits else None

    def allowing(self) -> SpanFit:
        """The fit that allows for as much as samples need that do not agree with exact equations."""
        least, near = self._torque_noise, None
        while self._torque_noise < MOST_TORQUE_NOISE:
            rise = UNKNOWN_RISE
            if np.isfinite(self.mean_square):
                rise = float(np.clip(np.sqrt(self.mean_square), LEAST_RISE, MOST_RISE))
            else:
                self.beta, self.motion = self.refined
            self._torque_noise = min(MOST_TORQUE_NOISE, rise * self._torque_noise)
            if self.converge(0.0) and self.mean_square <= LARGEST_MISFIT:
                near = self._taken(0.0)
                if self.mean_square <= LITTLE_MORE:
                    break
        if near is not None:
            return near
        self._torque_noise = least
        for level in ALLOWED:
            self.beta, self.motion = self.refined
            if self.converge(level) and self.mean_square <= LARGEST_MEAN_SQUARE:
                return self._taken(level)
        raise DivergedError(f"no motion and no parameters explain the samples, after {self.iterations} steps")

    def _taken(self, level: float) -> SpanFit:
        """The fit as it is, with error bars as wide as the innovations are beyond their noise."""
        beyond = self.mean_square if self.mean_square > LARGEST_MEAN_SQUARE else 1.0
        factor = self.factor / np.sqrt(beyond)
        return SpanFit(
            factor, self.beta, self.rows, self.mean_square, level, self._torque_noise, self.step, self.ending
        )

    def is_minimum_of(self, other: Search) -> bool:
        """Whether another search, from another start, has met the same minimum."""
        left = self.mean_square
        as_much = bool(np.isfinite(left)) and abs(left - other.mean_square) < SAME * other.mean_square
        return as_much and _near(self.factor, self.beta - other.beta, left)

    def would_fall(self) -> bool:
        """Whether derivatives at every node lead on from where those that are interpolated have led."""
        finer = copy(self)
        finer._interval = EVERY_NODE
        with suppress(*NO_NUMBERS):
            finer.advance(0.0)
        return finer.mean_square < HALF * self.mean_square

    def loosen(self, level: float) -> None:
        """Follow the samples with white forces of a level."""
        self._held = True
        for _ in range(MOST_TRIES):
            self.advance(level)
            if self.mean_square <= LARGEST_MEAN_SQUARE:
                return

    def converge(self, level: float, wanted: slice = slice(None), tame: bool = False, strictly: bool = False) -> bool:
        """Search until β, or what is wanted, converges, scatters within its errors or is refuted; whether it does.

        strictly: to scatter within its errors does not count.
        """
        self._held = False
        targets: list[Array] = []
        still = 0
        with suppress(*NO_NUMBERS):
            for _ in range(MAX_STEPS):
                before, left = self.beta, self.mean_square
                self.advance(level, tame)
                same = self.mean_square > LARGEST_MISFIT and abs(self.mean_square - left) < STILL * left
                still = still + 1 if same else 0
                if still == STILL_STEPS:
                    return True
                step = np.abs(self._asked[wanted])
                if np.all(step <= CONVERGED * self.std[wanted]):
                    return True
                longest = LONGEST_STEP if self.mean_square <= LARGEST_MEAN_SQUARE else LONGEST_MISFIT
                targets = [*targets, before + self._asked] if np.all(step <= longest * self.std[wanted]) else []
        if len(targets) >= FEWEST_TARGETS and not strictly:
            self.factor, self.beta = averaged(self.factor, targets[-FEWEST_TARGETS:])
            self.std = np.sqrt(np.diag(solve(triangular_factor(self._known, self.factor)).covariance()))
            return True
        self.mean_square = np.inf
        return False


def _near(factor: Array, apart: Array, mean_square: float) -> bool:
    """Whether two β of one span are apart (n,) by no more than errors; factor, mean_square: what one of them leaves."""
    n = apart.size
    return float(np.sum((factor[:n, :n] @ apart) ** 2)) <= n * mean_square
