"""Mistakes of units in samples that no motion follows: without a motion there are no rows to compare.

Each unit that may be another one is undone, in some seconds of samples and then in all: the first is taken that a
motion follows throughout.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress

import numpy as np

from sms_online.description.channels import drive_channels
from sms_online.description.schema import System
from sms_online.diagnosis.captures import undone
from sms_online.diagnosis.mistakes import Corrected, Mistake
from sms_online.diagnosis.sample_mistakes import MistakeHypothesis, mistake_hypotheses, torque_mistakes
from sms_online.errors import InputError
from sms_online.stream import Block

# Kinds of mistakes that make readings so large that no motion follows them.
UNITS = ("degrees", "milliradians", "millimetres", "converted", "motor_angle")
# Seconds of samples that are tried: those in which torques move most.
TRIED = 2.0


def find_followed(
    system: System, run: Sequence[Block], follow: Callable[[Sequence[Block]], list[Block]]
) -> tuple[Corrected, list[Block]] | None:
    """What to undo in a capture so that a motion follows it, and the capture as followed; None where nothing helps.

    follow: raises InputError where no motion does.
    """
    some = _moving(system, run)
    for hypothesis in _too_large(system, run[0].channels):
        found = Corrected((_mistake(hypothesis),), hypothesis.apply, system)
        with suppress(InputError):
            follow(undone(some, found))
            return found, follow(undone(run, found))
    return None


def _too_large(system: System, channels: Sequence[str]) -> Iterator[MistakeHypothesis]:
    """Hypotheses of samples that are too large, those of most channels first."""
    joints = [i - 1 for name, i in drive_channels(system).items() if name in channels]
    together = [(*joints,)] if joints else []
    for which in dict.fromkeys((*together, *((i,) for i in joints))):
        yield from (each for factor, each in torque_mistakes(system, which) if abs(factor) < 1.0)
    units = [each for each in mistake_hypotheses(system, channels) if each.name in UNITS]
    yield from sorted(units, key=lambda each: not each.where.startswith("all"))


def _mistake(hypothesis: MistakeHypothesis) -> Mistake:
    return Mistake(hypothesis.name, hypothesis.where, hypothesis.sentence, hypothesis.step, np.inf, 1.0)


def _moving(system: System, run: Sequence[Block]) -> list[Block]:
    """The samples of some seconds in which torques vary most."""
    t, values = (np.concatenate([getattr(block, part) for block in run]) for part in ("t", "values"))
    drives = [run[0].channels.index(name) for name in drive_channels(system) if name in run[0].channels]
    starts = np.arange(t[0], max(t[0], t[-1] - TRIED) + 0.5 * TRIED, 0.5 * TRIED)

    def varies(start: float) -> float:
        inside = values[(t >= start) & (t < start + TRIED)][:, drives]
        known = np.isfinite(inside).sum(axis=0)
        return float(np.sum(np.nanvar(inside, axis=0))) if known.size and known.min() > 1 else 0.0

    begin = max(starts.tolist(), key=varies)
    inside = (t >= begin) & (t < begin + TRIED)
    return [Block(t[inside], run[0].channels, values[inside])]
