"""Mistakes of wiring, units and signs, tried before any physics: what a person would check first.

Each is undone in a copy of the samples and asked whether the system then explains them where it did not: by the share
of every coordinate's rows that a rough fit leaves. Scales and signs of single torques show against the other rows.
What scales everything alike leaves no residual; there the described nominal values decide.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from sms_online.description.channels import concerns, drive_channels
from sms_online.description.schema import System
from sms_online.diagnosis.agreeing_encoders import AgreeingEncoders
from sms_online.diagnosis.record import Segment
from sms_online.diagnosis.rough_fit import SMALLEST, RoughFit, RoughRows, stretches
from sms_online.diagnosis.sample_mistakes import (
    MistakeHypothesis,
    mistake_hypotheses,
    scaled,
    shown,
    torque_mistakes,
    without_gaps,
)
from sms_online.nominal import is_geared
from sms_online.pipeline.estimator import Estimator
from sms_online.sample_faults import unit_of_stamps
from sms_online.stream import Array

# Rows for each unknown at least.
LEAST_ROWS = 5.0
# A coordinate of whose rows less is left than this is explained as well as a rough fit can.
EXPLAINED = 0.02
# One of whose rows less is left than this lacks physics at most, no unit or sign of a position.
PHYSICS = 0.1
# Nominal values leave less: a data sheet is right to a quarter.
AS_STATED = 0.3
# A mistake is named where undoing it divides what is left by this at least, the factors of all coordinates multiplied.
LEAST_RATIO = 10.0
# Where samples show it by themselves, by this; where it scales everything alike, which nominal values alone show, by
# that.
LEAST_SHOWN, LEAST_COMMON = 1.1, 3.0
# A torque in its right unit or gear leaves no coordinate more than this multiple of what it left before, unless that is
# little: else what the model lacks has only been moved from one coordinate to another.
MOST_WORSE = 2.0
# Nor is it further from what nominal values make of it than before, by this factor: friction is no part of them.
MOST_OFF = 2.0
# Mistakes whose ratios differ by less than this factor are not distinguishable.
SAME_RATIO = 1.5
# Torque constants and gears differ from their data sheets by less.
LARGEST_GAIN = 1.3
# Several devices stamp samples more often than one, and some are lost.
SAME_CLOCK = 20.0
# At most so many mistakes are looked for in turn.
MOST = 3
# A factor of a torque that divides what is left by this may be one of the gear, which is then tried for itself; of
# mistakes that explain all coordinates one is clearly worse that leaves as much more.
LIKELY = 3.0
# A gear is described as smaller or larger by less than this factor.
LARGEST_GEAR = 30.0
# What falls where a description has no gravity, m/s².
FALL = 9.81


@dataclass(frozen=True)
class Mistake:
    """A mistake that undone explains the samples.

    name: its kind. where: a channel, a joint, or several, comma separated. sentence: what is wrong, in words. step:
    what to do. before, after: how much more than what counts as explained a rough fit leaves, the factors of all
    coordinates multiplied; equal where only nominal values show it. or_else: sentences of others that explain as much.
    """

    name: str
    where: str
    sentence: str
    step: str
    before: float
    after: float
    or_else: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """name@where."""
        return f"{self.name}@{self.where}"


@dataclass(frozen=True)
class Corrected:
    """Samples and system without the mistakes that were found.

    mistakes: what was found, one after the other; samples: undoes them in values (B, channels), in place of the
    channels of a session. system: with what of it the description states."""

    mistakes: tuple[Mistake, ...]
    samples: Callable[[tuple[str, ...], Array], Array]
    system: System


def find_mistakes(session: Estimator, segments: Sequence[Segment], without: Sequence[str] = ()) -> Corrected:
    """Undo one mistake after the other while that explains the samples far better.

    session: that of the system as described; segments: its samples; without: channels that no sensor reads.
    """
    search = _Search(session, stretches(session, segments), without)
    while len(search.found) < MOST and search.step():
        pass
    return Corrected(tuple(search.found), search.undo, search.system)


def wrong_clock(system: System, t: Array) -> Mistake | None:
    """Stamps (B,) in a unit other than seconds, by the description's sample rate."""
    steps = np.diff(t)
    steps = steps[steps > 0.0]
    if not steps.size:
        return None
    stamps = unit_of_stamps(float(np.median(steps)) * system.sample_rate, SAME_CLOCK)
    if stamps is None:
        return None
    unit, factor = stamps
    return Mistake("clock_unit", "t", f"t is in {unit} in place of s", f"divide t by {factor:g}", factor, 1.0)


class _Search:
    def __init__(self, session: Estimator, segments: Sequence[Segment], without: Sequence[str]) -> None:
        self.session, self.system = session, session.system
        self.found: list[Mistake] = []
        self._channels = session.sensing.channels
        self._read = tuple(name for name in self._channels if name not in without)
        self._segments = list(segments)
        self._undone: list[MistakeHypothesis] = []
        self._drives = {i - 1: name for name, i in drive_channels(self.system).items()}

    def undo(self, channels: tuple[str, ...], values: Array) -> Array:
        """Samples without the mistakes found."""
        for hypothesis in self._undone:
            values = hypothesis.apply(channels, values)
        return values

    def step(self) -> bool:
        """Look for one more; whether there is one."""
        try:
            rows = RoughRows(self.session, self._segments)
            given, freed = rows.fit(), rows.freed()
        except np.linalg.LinAlgError:
            return False
        if rows.for_each < LEAST_ROWS:
            return False  # so many parameters explain any samples
        by_themselves = (each for each in shown(self._channels, self._segments) if concerns(each.where, self._read))
        found = list(self._samples(by_themselves, given, EXPLAINED, LEAST_SHOWN))
        if not found:
            found = list(self._scaled(rows, freed))
            if _left(given, PHYSICS) > LEAST_RATIO:
                every = (*mistake_hypotheses(self.system, self._read), *_gravities(self.system))
                pairs = AgreeingEncoders(self._channels, self._segments)
                likely = self._likely(each for each in every if not pairs.separated(each))
                found += self._samples(likely, given, PHYSICS, LEAST_RATIO)
        if not found:
            return False
        least = SAME_RATIO * min(_left(each.fit) for each in found)
        near = sorted((each for each in found if _left(each.fit) < least), key=lambda each: _left(each.fit))
        # All of these explain what a rough fit can; nominal values decide unless one clearly leaves least.
        finest = min(_finely(each.fit) for each in near)
        best, *others = (each for each in near if _finely(each.fit) < finest + np.log(LIKELY))
        self._take(best, _left(freed), tuple(each.hypothesis.sentence for each in others))
        return True

    def _scaled(self, rows: RoughRows, given: RoughFit) -> Iterator[_Tried]:
        """Factors of torques that explain the samples, by fits in which rows without a torque do not follow one.

        Such a fit has several minima. So without the factor it begins as well where it led to with it.
        """
        before = _left(given)
        if before <= LEAST_COMMON:
            return
        most = np.maximum(MOST_WORSE * given.left, PHYSICS)
        for each in self._torques(rows):
            if each.geared is not None and before > LIKELY * _left(each.fit):
                each = self._in_gear(each, each.geared)
            explained = (LEAST_COMMON if each.common else LEAST_RATIO) * _left(each.fit)
            better = before > explained and np.all(each.fit.left <= most)
            if better and _left(rows.freed(start=each.fit.beta)) > explained:
                yield each

    def _in_gear(self, tried: _Tried, geared: MistakeHypothesis) -> _Tried:
        """The factor of a torque, or of the gear ratio in the description where that explains more.

        A rotor's inertia acts with the square of the ratio on its own joint and with the ratio on the bodies that it
        turns with: that distinguishes a gear from a torque constant.
        """
        try:
            fit = self._rows(geared, self._segments).freed()
        except np.linalg.LinAlgError:
            return tried
        return _Tried(geared, fit) if _finely(fit) < _finely(tried.fit) else tried

    def _take(self, best: _Tried, before: float, others: tuple[str, ...]) -> None:
        u = best.hypothesis
        self._undone.append(u)
        self.found.append(Mistake(u.name, u.where, u.sentence, u.step, before, _left(best.fit), others))
        self._segments = self._corrected(u, self._segments)
        self.system, self.session = self._session(u)

    def _session(self, hypothesis: MistakeHypothesis) -> tuple[System, Estimator]:
        """System and session without a mistake of the description."""
        if hypothesis.system is None:
            return self.system, self.session
        system = hypothesis.system(self.system)
        return system, Estimator(system, self._channels, "")

    def _rows(self, hypothesis: MistakeHypothesis, segments: Sequence[Segment]) -> RoughRows:
        """Rows of some segments without a mistake; numpy.linalg.LinAlgError as `RoughRows` raises it."""
        return RoughRows(self._session(hypothesis)[1], self._corrected(hypothesis, segments))

    def _corrected(self, hypothesis: MistakeHypothesis, segments: Sequence[Segment]) -> list[Segment]:
        made = (replace(each, values=hypothesis.apply(self._channels, each.values)) for each in segments)
        return [part for each in made for part in without_gaps(each)]

    def _likely(self, tried: Iterable[MistakeHypothesis]) -> Iterator[MistakeHypothesis]:
        """Those that divide what is left of the first stretch by the root of LEAST_RATIO, or all if it is too short."""
        first, rows = self._segments[:1], None
        if len(self._segments) > 1:
            with suppress(np.linalg.LinAlgError):
                rows = RoughRows(self.session, first)
        if rows is None or rows.for_each < LEAST_ROWS:
            yield from tried
            return
        least = _left(rows.fit(), PHYSICS) / np.sqrt(LEAST_RATIO)
        for hypothesis in tried:
            try:
                left = _left(self._rows(hypothesis, first).fit(), PHYSICS)
            except np.linalg.LinAlgError:
                continue  # readings that no shape of the links gives
            if left <= least:
                yield hypothesis

    def _samples(
        self, tried: Iterable[MistakeHypothesis], given: RoughFit, explained: float, least: float
    ) -> Iterator[_Tried]:
        """Those that divide what a fit leaves by a ratio at least, and those that are certain.

        By least squares, which has one minimum: freed rows may get to a better one by chance where others do not.
        """
        for hypothesis in tried:
            try:
                rows = self._rows(hypothesis, self._segments)
                better = _left(given, explained) / _left(rows.fit(), explained) > least
            except np.linalg.LinAlgError:
                continue  # readings that no shape of the links gives
            if better or hypothesis.certain:
                yield _Tried(hypothesis, rows.freed())

    def _torques(self, rows: RoughRows) -> Iterator[_Tried]:
        """Known factors of each joint's torque and of all, and the gear ratio of each that the other rows ask for."""
        joints, stated = list(self._drives), rows.stated()

        def likely(which: Sequence[int], factor: float) -> bool:
            known = stated[list(which)]
            known = known[known > 0.0]
            return bool(np.all(np.abs(np.log(abs(factor) * known)) <= np.abs(np.log(known)) + np.log(MOST_OFF)))

        def times(which: Sequence[int], factor: float) -> Array:
            factors = np.ones(stated.size)
            factors[list(which)] = factor
            return factors

        for which in dict.fromkeys(((*joints,), *((i,) for i in joints))):
            for factor, hypothesis in torque_mistakes(self.system, which):
                if likely(which, factor):
                    yield _Tried(hypothesis, rows.freed(times(which, factor)), len(which) == len(joints))
        for i in joints:
            gear = self.system.joints[i].gear_ratio
            if len(joints) == 1 or not is_geared(self.system.joints[i]):
                continue
            best = rows.factor(i)
            gained = 1.0 / LARGEST_GAIN < best < LARGEST_GAIN
            if not gained and 1.0 / LARGEST_GEAR < best < LARGEST_GEAR and likely([i], best):
                where, ratio = f"joint_{i + 1}", gear * best
                drive = self._drives[i]
                said = f"{drive} is {1.0 / best:.3g} × what the other rows give: its torque constant or the gear ratio"
                then = f"check the torque constant of {where}, then its gear ratio"
                hypothesis = MistakeHypothesis("gear_ratio", where, said, then, scaled([drive], best))
                said = f"the gear ratio of {where} looks like {ratio:.3g}, described as {gear:g}"
                then = f"check the gear ratio of {where}, then its torque constant"
                geared = MistakeHypothesis("gear_ratio", where, said, then, _same, _geared(i, best))
                yield _Tried(hypothesis, rows.freed(times([i], best)), geared=geared)


@dataclass(frozen=True)
class _Tried:
    """A fit with a mistake undone.

    fit: that one, rows without a torque freed. common: whether it scales all torques alike. geared: the same factor in
    the gear ratio that the system describes."""

    hypothesis: MistakeHypothesis
    fit: RoughFit
    common: bool = False
    geared: MistakeHypothesis | None = None


def _finely(fit: RoughFit) -> float:
    """Sum over the coordinates of the logarithm of what is left: the product may be below what floats hold."""
    return float(np.sum(np.log(np.maximum(fit.left, SMALLEST))))


def _left(fit: RoughFit, explained: float = EXPLAINED) -> float:
    """Product over the coordinates, as likelihoods compare; what is explained counts as such."""
    fitted, stated = np.maximum(fit.left, explained) / explained, np.maximum(fit.nominal, AS_STATED) / AS_STATED
    return float(np.exp(np.sum(np.log(fitted)) + np.sum(np.log(np.minimum(stated, 1.0 / AS_STATED)))))


def _same(channels: tuple[str, ...], values: Array) -> Array:
    return values


def _gravities(system: System) -> Iterator[MistakeHypothesis]:
    """Gravity along another axis of the base, or none: an arm that hangs, or leans on a wall."""
    described = np.array(system.gravity)
    size = float(np.linalg.norm(described)) or FALL
    axes = np.eye(3)[: 2 if system.motion == "planar" else 3]
    for vector in (np.zeros(3), *(sign * size * axis for axis in axes for sign in (1.0, -1.0))):
        if np.linalg.norm(vector - described) < 0.5 * size:
            continue
        found = tuple((vector + 0.0).tolist())  # no negative zeros
        new, old = (f"({', '.join(f'{g:g}' for g in each)}) m/s²" for each in (found, system.gravity))
        said = f"gravity looks like {new}, described as {old}"
        yield MistakeHypothesis(
            "gravity", "base", said, "check how the base is mounted, then `gravity`", _same, _falling(found)
        )


def _falling(gravity: tuple[float, ...]) -> Callable[[System], System]:
    return lambda system: system.model_copy(update={"gravity": gravity})


def _geared(i: int, factor: float) -> Callable[[System], System]:
    def change(system: System) -> System:
        joints = list(system.joints)
        joints[i] = joints[i].model_copy(update={"gear_ratio": joints[i].gear_ratio * factor})
        return system.model_copy(update={"joints": tuple(joints)})

    return change
