"""What a session contradicts in its description: calibrations, places of effects, values known beforehand."""

from __future__ import annotations

import numpy as np

from sms_online.calibration.found import CERTAIN
from sms_online.calibration.nuisance import BOUND
from sms_online.effects.catalogue import either, in_words
from sms_online.evaluation import Evaluation
from sms_online.row_types import row_types
from sms_online.trackers.build import drifts_of
from sms_online.verdict.evidence import Dispute
from sms_online.verdict.reasons import STATE_HOLD, undecided
from sms_online.verdict.truncated import FIRST_ORDER, truncated
from sms_online.verdict.trust import Reason

# An estimate further from its prior than this many of the prior's deviations agrees with it by no chance.
LARGEST_DISPUTE = 3.0
# A clock this many tolerances off may have moved on the way.
MOVED = 1.5
# Clocks are alike within this share of what they are off by.
ALIKE = 0.05


def miscalibrated(evaluation: Evaluation) -> list[Reason]:
    """Where the description is wrong by more than its tolerances allow.

    Corrections of the rows are linear, up to a bound; samples are moved in time by whatever a clock is late.
    A clock that moves on the way looks like a change of parameters: beside one, less counts. And where elements are so
    few that a correction of first order leaves more than error bars count.
    """
    changed = any(event.parameters for event in evaluation.statistics.events)
    held, corrected = _held_torques(evaluation), _corrected_clocks(evaluation)
    out = list(held)
    for each in evaluation.calibration:
        if each.tolerance is None or (held and each.name == "clock"):
            continue
        tolerances = abs(each.estimate) / each.tolerance
        if each.beyond or (changed and each.name == "clock" and tolerances > MOVED):
            text = f"{each}: {tolerances:.0f} tolerances"
            moved = each.name == "clock" and (each.where, each.part) in corrected
            grave = tolerances > BOUND and not moved
            out.append(Reason(text, grave, full=f"{each}: {each.advice}", then=each.advice))
    return [*out, *(each.reason for each in truncated(evaluation) if abs(each.share) > FIRST_ORDER)]


def _corrected_clocks(evaluation: Evaluation) -> set[tuple[str, str]]:
    """Device and part of each clock that samples are corrected by, to what is linear."""
    momentum, estimate = evaluation.statistics.momentum, evaluation.estimate
    if momentum is None or estimate.nuisances.size != momentum.point.size:
        return set()
    each = zip(evaluation.statistics.setup.nuisances, momentum.point, estimate.nuisances, strict=True)
    return {
        (nuisance.where, nuisance.part)
        for nuisance, point, value in each
        if nuisance.name == "clock" and point and abs(value - point) <= BOUND * nuisance.tolerance
    }


def _held_torques(evaluation: Evaluation) -> list[Reason]:
    """A reason where torques act half a sample later than stamped, as held commands do."""
    setup = evaluation.statistics.setup
    half = 0.5 * float(np.nanmax(evaluation.statistics.periods[list(setup.sensing.torque_columns)], initial=0.0))
    clocks = [each for each in evaluation.calibration if each.name == "clock"]
    count = sum(each.name == "clock" for each in setup.nuisances)
    alike = all(abs(each.estimate - half) < max(CERTAIN * each.std, ALIKE * half) for each in clocks)
    if not count or len(clocks) < count or not alike or not all(each.beyond for each in clocks):
        return []
    text = f"the torques act {1e3 * half:.2g} ms after their stamps: commands that are held over the sample"
    return [Reason(text, False, then=STATE_HOLD)]


def ambiguous_effects(evaluation: Evaluation) -> list[Reason]:
    """Effects of the description, larger than their tolerance, that may as well be the other way elsewhere."""
    system, out = evaluation.model.system, []
    scale = system.scale_tolerance
    determined = zip(evaluation.parameters, evaluation.estimate.pi.tolist(), evaluation.determined, strict=True)
    estimates = {parameter.name: value for parameter, value, known in determined if known}
    for effect in system.effects:
        other = either(effect, system)
        key = f"{effect.key}."
        values = {name.removeprefix(key): value for name, value in estimates.items() if name.startswith(key)}
        if other and scale is not None and any(abs(value) > scale for value in values.values()):
            out.append(undecided(in_words(effect, system, values), effect.where, other))
    return out


def _moving(evaluation: Evaluation) -> list[int]:
    """Columns of the parameters that drift in the judged estimate: as was found, or as its choice lets them."""
    now = evaluation.statistics
    found = [drift.column for drift in now.readings[0].drifts] if now.readings else []
    choice = now.setup.trackers[0]
    if choice.kind != "kalman":
        return found
    let = drifts_of(choice, evaluation.parameters, evaluation.model.system.name)
    return [*found, *(k for k, drift in enumerate(let) if drift in ("random_walk", "trend"))]


def disputes(evaluation: Evaluation) -> list[Dispute]:
    """Parameters that the data pull further from what was known of them beforehand than that allows.

    What drifts may go as far as it likes: it was known of the beginning.
    """
    now, prior = evaluation.statistics, evaluation.statistics.setup.current_prior
    if prior is None:
        return []
    off = np.zeros(prior.std.size)
    off[prior.known] = ((evaluation.estimate.pi - prior.value) / prior.std)[prior.known]
    off[_moving(evaluation)] = 0.0
    far = np.flatnonzero(np.abs(off) > LARGEST_DISPUTE)
    if not far.size:
        return []
    scale_free = None if now.method != "momentum" or now.momentum is None else now.momentum.scale_free
    slopes = None if scale_free is None else scale_free.minimum().slopes[:, len(now.setup.nuisances) :]
    out = []
    for k in far.tolist():
        row = None
        if slopes is not None:
            # The criterion falls on the way from the prior to where rows want the parameter.
            types = row_types(evaluation.model.layout)
            pulls = {name: float(-np.sign(off[k]) * slopes[rows, k].sum()) for name, rows in types.items()}
            row = max(pulls, key=lambda name: pulls[name])
        out.append(Dispute(evaluation.parameters[k].name, float(off[k]), row))
    return out
