"""Changes while a smoother runs: a span that contradicts what is known, and what explains the samples behind it.

Rows of the span behind the change are those of a model in which whatever may jump is free. What is known from before
and these rows compare the hypotheses, as behind an event of the momentum balance.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np

from sms_online.description.bodies import FlexibleLink, Inertia, RigidBody
from sms_online.description.schema import System
from sms_online.effects.build import build_model, changed_model
from sms_online.model.base_parameters import BaseParameters
from sms_online.pipeline.event_hypotheses import (
    Explanation,
    Jump,
    additional,
    everything,
    explain,
    extended,
    hypotheses,
    restricted,
)
from sms_online.pipeline.sensing import Sensing
from sms_online.smoother.fit import diverging
from sms_online.smoother.gatherer import Gatherer
from sms_online.smoother.gauss_newton import EVERY_NODE, DivergedError
from sms_online.smoother.problem import SpanProblem
from sms_online.smoother.search import LARGEST_MEAN_SQUARE, Search, SpanFit
from sms_online.stream import Array
from sms_online.trackers import factor as factors

# A span contradicts what is known where χ² of its rows exceeds its expectation by so many standard deviations.
ALARM = 15.0
# Levels of the white forces by which the samples behind a change are followed, ever tighter, and steps at each: what
# has jumped is found roughly first. And the steps of the collocation, s: what has jumped may have made modes faster.
LEVELS, ADVANCES = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 0.0), 2
STEP = 0.005
# A payload's inertia is hard to find from nothing: it is looked for from one of such shares of the heaviest link's
# mass, too, with a radius of gyration of such a share of the longest link. What is left of one that is released is
# looked for from such a share of it.
PAYLOADS, GYRATION, LESS = (0.3, 3.0), 0.2, 0.05
# Mean square of the whitened innovations that the right step leaves, as far as it is found: the fit behind it is exact.
EXPLAINED = 4.0


def contradicts(known: Array, fit: SpanFit | DivergedError) -> bool:
    """Whether a span, fitted beside what is known, shows that something has changed.

    known (n + 1, n + 1): information before it, whose equations of motion were exact.
    """
    if isinstance(fit, DivergedError) or fit.inexact > (0.0, 1.0) or fit.mean_square > LARGEST_MEAN_SQUARE:
        return True
    n = len(known) - 1
    before = known.copy()
    before[-1] = 0.0
    chi2 = float(factors.extended(before, fit.factor[:n])[-1, -1] ** 2)
    return bool(chi2 > n + ALARM * np.sqrt(2.0 * n))


@dataclass(frozen=True)
class Step:
    """What explains a span behind a change best.

    explains: whether it leaves little but noise. names: of the parameters that jumped; fresh: of those that are new.
    """

    explanation: Explanation
    explains: bool
    names: tuple[str, ...]
    fresh: tuple[str, ...]

    @property
    def kind(self) -> str:
        """Of the event."""
        return "unexplained" if self.explanation.jump is None else self.explanation.jump.kind

    @property
    def clear(self) -> bool:
        """Whether it leaves little but noise, and no other step does."""
        return self.explains and self.explanation.decisive


class SpanChanges:
    """Explains changes of one session. problem: of the system as described; sensing, channels: see `SpanProblem`."""

    def __init__(self, problem: SpanProblem, sensing: Sensing, channels: tuple[str, ...]) -> None:
        self._described, self._sensing, self._channels = problem, sensing, channels

    def problem(self, added: list[str]) -> SpanProblem:
        """The problem with parameters that events have added."""
        if not added:
            return self._described
        model, base = self._described.model, self._described.base
        larger = changed_model(model, restricted(model.system, added))
        return SpanProblem(larger, extended(base, larger, added), self._sensing, self._channels)

    def explain(
        self, gathered: Gatherer, count: int, noise: tuple[Array, Array, float], known: tuple[Array, Array],
        now: SpanProblem, added: list[str],
    ) -> Step:  # fmt: skip
        """The best explanation of the first `count` torques gathered, behind a change, by a step of parameters.

        noise: see `SpanProblem`. known: before the change, of the parameters of now: information (m + n + 1, m + n +
        1), and estimate (m + n,). DivergedError where no parameters explain the samples.
        """
        system = now.model.system
        whole = changed_model(now.model, everything(system))
        names = additional(system, whole, now.base)
        base = extended(self._described.base, whole, [*added, *names])
        smoother, span = SpanProblem(whole, base, self._sensing, self._channels)(gathered, count, *noise)
        m = smoother.m
        jumps = [replace(jump, columns=tuple(m + k for k in jump.columns)) for jump in hypotheses(base.parameters)]
        tried = list[tuple[float, Explanation]]()
        past = np.concatenate((known[1], np.zeros(len(names))))
        carried = [m + k for k, p in enumerate(base.parameters) if p.name.startswith("payload.")]
        for start in [past, *_with_payloads(past, carried, base, system)]:
            with suppress(DivergedError):
                search = Search(smoother, span, start, np.empty((0, start.size + 1)), interval=EVERY_NODE)
                tried.append(_tightened(search, known[0], jumps))
                if tried[-1][0] <= EXPLAINED:
                    break
        if not tried:
            raise DivergedError("no parameters explain the samples behind a change")
        left, found = min(tried, key=itemgetter(0))
        columns = () if found.jump is None else found.jump.columns
        jumped = tuple(base.parameters[k - m].name for k in columns)
        return Step(found, left <= EXPLAINED, jumped, tuple(name for name in jumped if name in names))


def _tightened(search: Search, known: Array, jumps: list[Jump]) -> tuple[float, Explanation]:
    """The best of the jumps, as equations of motion tighten, from where it was found before; first what it leaves.

    That is the mean square of the whitened innovations.
    """
    n = len(known) - 1
    beta = search.beta
    with diverging():
        search.refine(STEP)
        for level in LEVELS:
            search.hold(beta)
            for _ in range(ADVANCES):
                search.advance(level)
            found = explain(known, search.factor[:-1], jumps)
            beta = np.concatenate((found.beta, np.zeros(beta.size - n)))
            if found.jump is not None and found.needed:
                beta[list(found.jump.columns)] += found.sizes
        search.hold(beta)
        search.advance(0.0)
    return search.mean_square, found


def _with_payloads(past: Array, carried: list[int], base: BaseParameters, system: System) -> Iterator[Array]:
    """β (m + n,) as it was, with payloads in place of none, or with less of one; carried: their columns."""
    if past[carried].any():
        less = past.copy()
        less[carried] *= LESS
        yield less
        return
    flexible = [link for link in system.links if isinstance(link, FlexibleLink)]
    masses = [link.mass for link in system.links if not isinstance(link, FlexibleLink)]
    heaviest = max([*masses, *(link.mass_per_length * link.length for link in flexible)])
    about = (GYRATION * max([link.length for link in flexible], default=1.0)) ** 2
    for mass in (share * heaviest for share in PAYLOADS):
        body = RigidBody(mass=mass, inertia=Inertia(xx=mass * about, yy=mass * about, zz=mass * about))
        model = build_model(system.model_copy(update={"payload": body}))
        value = {p.name: p.nominal for p in model.parameters}
        with_one = past.copy()
        with_one[carried] = [value[base.parameters[k - past.size + base.n].name] for k in carried]
        yield with_one
