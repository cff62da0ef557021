"""Parameters and states of a span together: Gauss-Newton on all samples at once, with the equations as constraints.

Only the torques are uncertain in the end. The way there leads over equations that hold roughly: white forces of a level
that falls step by step act on every coordinate, so that at first the motion follows the samples and the parameters
follow the motion, as in a fit of the balance; a start that is tens of percent off then suffices. Where the samples
refute exact equations, the least level stays that they agree with.
Source: Ramsay, Hooker, Campbell, Cao, J. Royal Statistical Society B 69 (2007) 741, for the path from loose to tight
equations.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np

from sms_online.pipeline.description import LOOSE, described, near_rows
from sms_online.smoother.gauss_newton import DERIVATIVES_INTERVAL, EVERY_NODE, NO_NUMBERS, DivergedError
from sms_online.smoother.readings import SmoothedReadings
from sms_online.smoother.search import LARGEST_MEAN_SQUARE, Search, SpanFit
from sms_online.smoother.span import Ending, Span
from sms_online.stream import Array

# Levels of the white forces on the way, as shares of each coordinate's usual force. From one to the next the answer
# moves by a fraction of what the first fit is off.
LEVELS = (0.3, 0.1, 0.03, 0.01, 0.003, 0.001)
# Those that a span begins with whose parameters are known from the spans before it.
LATER_LEVELS = (0.01, 0.001, 0.0)
# And that of a span whose first state is known, too.
NEXT_LEVELS = (0.0,)
# Level, and times the torques' noise, up to which no other start is tried: what a poor one leaves is far more.
NEARLY_EXACT = (0.0, 3.0)
# Those by which a motion follows the samples without a fit, whatever else acts: the lower one is, the smoother is the
# motion. And how far parameters may be from the description then, as a share of it, 1σ: held, where they run away.
FOLLOWING = (3.0, 1.0, 0.3, 0.1)
NEAR, HELD = 0.5, 1e-4
# Steps of the collocation, s, ever finer. Where a motion is too fast for those of the spans before: a share of them.
STEPS = (0.005, 0.0025, 0.00125)
FINER = 0.5


@contextmanager
def diverging() -> Iterator[None]:
    """Whatever a search ends in that runs away is a DivergedError."""
    try:
        with np.errstate(over="raise", divide="raise", invalid="raise"):
            yield
    except NO_NUMBERS as error:
        raise DivergedError(str(error)) from None


def _followed(search: Search) -> float:
    """The lowest level of white forces by which a motion follows the samples; DivergedError where there is none."""
    followed = None
    for level in FOLLOWING:
        before = search.beta, search.motion
        with suppress(*NO_NUMBERS):
            search.loosen(level)
            if search.mean_square <= LARGEST_MEAN_SQUARE:
                followed = level
                continue
        search.beta, search.motion = before
        break
    if followed is None:
        raise DivergedError("no motion explains the samples, whatever forces act")
    return followed


class SpanSmoother(SmoothedReadings):
    """Fits spans of one session."""

    def fit(
        self, span: Span, beta: Array, known: Array, last_step: float | None, before: Ending | None = None,
        exactly: bool = False,
    ) -> SpanFit:  # fmt: skip
        """Fit a span from β (n,), with what is known before it as a factor or rows (·, n + 1).

        last_step: of the collocation of an earlier span, s; None where none is known to be fine enough. before: of the
        span that this one goes on from. Raises DivergedError; exactly: also where samples do not agree with the
        equations of motion.
        """
        with diverging():
            if last_step is None:
                return self._first(span, beta, known, exactly)
            if before is not None:
                with suppress(*NO_NUMBERS):
                    search = Search(self, span, beta, known, before=before)
                    return search.through(NEXT_LEVELS, (last_step,), exactly)
            with suppress(*NO_NUMBERS):
                return Search(self, span, beta, known, kept=exactly).through(LATER_LEVELS, (last_step,), exactly)
            try:
                # The motion may be too fast for such steps and derivatives.
                search = Search(self, span, beta, known, interval=EVERY_NODE, kept=exactly)
                search.refine(last_step)
                return search.through(LATER_LEVELS, (last_step, FINER * last_step), exactly)
            except NO_NUMBERS:
                if exactly:
                    raise
                # Parameters are known, but not the motion, where cameras have not seen a link for a while.
                return Search(self, span, beta, known).through(LEVELS, (last_step,))

    def follow(self, span: Span, beta: Array, known: Array) -> Search:
        """The search that has converged on a span, by the tightest of loose equations that the samples agree with.

        Its factor holds what samples say of nuisances; its β (n,) is near the description, or the description where
        forces that the model lacks would lead parameters astray. See `fit`; raises DivergedError.
        """
        value, size = described(self.model, self.base)
        for near, start in ((NEAR, beta), (HELD, np.concatenate((beta[: self.m], value)))):
            rows = near_rows(value, near / LOOSE * size, self.m)
            with suppress(DivergedError), diverging():
                search = Search(self, span, start, np.concatenate((known, rows)))
                level = _followed(search)
                if not self.m or search.converge(level, slice(self.m), tame=True):
                    return search
        raise DivergedError("no motion explains the samples, whatever forces act")

    def _first(self, span: Span, beta: Array, known: Array, exactly: bool) -> SpanFit:
        """From the start that leads to equations that hold, or else to those that hold best."""
        inexact, refuted = list[Search](), False
        for interval in (DERIVATIVES_INTERVAL, EVERY_NODE):
            for search in self._begun(span, beta, known, interval):
                with suppress(*NO_NUMBERS):
                    if (fit := search.exact(LEVELS[1:], STEPS)) is not None:
                        return fit
                    if any(map(search.is_minimum_of, inexact)):
                        refuted = not search.would_fall()
                    else:
                        inexact.append(search)
            if refuted:
                break  # two starts have met one minimum, and it leaves more than noise
        if exactly:
            raise DivergedError("samples do not agree with the equations of motion")
        fits, why = list[SpanFit](), "neither the balance's fit nor the description leads to the samples"
        for search in inexact:
            try:
                fit = search.allowing()
            except NO_NUMBERS as error:
                why = str(error)
                continue
            if fit.level > 0.0:
                # A start that is far off may end there too. From this one, which is near, exact equations are met if
                # they hold.
                with suppress(*NO_NUMBERS):
                    again = Search(self, span, fit.beta, known, search.reach).through(LEVELS, STEPS)
                    fit = min(fit, again, key=lambda each: each.inexact)
            met_again = any(map(fit.is_minimum_of, fits))
            fits.append(fit)
            if met_again or fit.inexact <= NEARLY_EXACT:
                break
        if not fits:
            raise DivergedError(why)
        return min(fits, key=lambda each: each.inexact)

    def _begun(self, span: Span, beta: Array, known: Array, interval: float) -> Iterator[Search]:
        """Searches at the first level, from β (n,) and from the description; first what leads near to the samples.

        From the description what loose equations do not determine is to stay near it. interval: see `Search`.
        """
        later = []
        value, size = described(self.model, self.base)
        start_anew = np.concatenate((beta[: self.m], value)), np.concatenate((np.zeros(self.m), size))
        for start, reach in ((beta, None), start_anew):
            try:
                search = Search(self, span, start, known, reach, interval=interval)
                search.loosen(LEVELS[0])
            except NO_NUMBERS:
                continue
            if search.mean_square <= LARGEST_MEAN_SQUARE:
                yield search
            else:
                later.append(search)
        yield from sorted(later, key=lambda search: search.mean_square)
