"""A diagnosis of captures as they were recorded, where coordinates may have to be reconstructed for its rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sms_online.description.schema import System
from sms_online.diagnosis.attempt import SEARCHED, PriorOf, Progress
from sms_online.diagnosis.captures import in_seconds, one_after_another, undone
from sms_online.diagnosis.diagnose import diagnose, run_through
from sms_online.diagnosis.followed_mistakes import find_followed
from sms_online.diagnosis.mistakes import Mistake, wrong_clock
from sms_online.diagnosis.search import Search
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import channel_effects
from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.sensing import not_smoothed
from sms_online.smoother.reconstruction import Reconstruction
from sms_online.stream import Block


def diagnose_recorded(
    system: System,
    runs: Sequence[Sequence[Block]],
    holdout: Sequence[Block],
    source: str,
    prior: PriorOf,
    progress: Progress,
    stop: Callable[[], bool],
    learned: bool,
) -> tuple[Search, list[str]]:
    """What was found, and warnings of what was reconstructed for it; see `diagnose`.

    Where a sensor is missing or too slow, what is found by reconstructed coordinates is fitted to the samples
    themselves by the smoother, if it can be.
    """
    reconstruction = Reconstruction(system, runs[0][0].channels, source)
    channels, mistakes = reconstruction.channels, tuple[Mistake, ...]()
    if channels:
        progress("reconstructing what no sensor follows", 0.0)
        clock = wrong_clock(system, np.concatenate([block.t for block in runs[0]]))
        if clock is not None:
            # No motion follows samples at such times.
            runs, holdout = [in_seconds(run, clock.before) for run in runs], in_seconds(holdout, clock.before)
            mistakes = (clock,)
    try:
        first = reconstruction(runs[0])
    except InputError:
        progress("looking for units that are others", 0.0)
        followed = find_followed(system, runs[0], reconstruction)
        if followed is None:
            raise
        wrong, first = followed
        runs, holdout = [undone(run, wrong) for run in runs], undone(holdout, wrong)
        mistakes = (*mistakes, *wrong.mistakes)
    held = reconstruction(holdout) if holdout else []
    further = [reconstruction(run) for run in runs[1:]]
    found = diagnose(reconstruction.system, first, source, prior, held, progress, stop, learned, further, channels)
    if not channels:
        return found, []
    restored = reconstruction.restored(found.after.system)
    found = replace(found, restored=restored, mistakes=(*mistakes, *found.mistakes))
    as_recorded = not (found.partial or found.mistakes or found.zeros or found.changes or found.drifts)
    if as_recorded and not not_smoothed(build_model(found.adopted)) and not channel_effects(found.adopted):
        progress("fitting the model with what was found", SEARCHED)
        found = _smoothed(found, runs, source, prior)
    return found, reconstruction.warnings


def _smoothed(found: Search, runs: Sequence[Sequence[Block]], source: str, prior: PriorOf) -> Search:
    """With parameters by the smoother where equations with what was found explain the samples.

    Dry friction that holds a joint allows for no exact equations; rows of momentum know of it.
    """
    session = Estimator(found.adopted, runs[0][0].channels, source, whole=True)
    run_through(session, one_after_another(runs), prior)
    if session.smoother is None or not session.by_smoother or not session.smoother.known.exact:
        return found
    if found.verdict == "unexplained":
        # Of samples that are explained nothing is unexplained, whatever errors reconstructed coordinates have.
        found = replace(found, verdict="named" if found.findings else "clean", unexplained=None)
    return replace(found, estimator_after=session)
