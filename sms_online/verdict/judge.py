"""May these numbers be trusted? One verdict on a session, from all the evidence for and against its estimate.

It is reached here alone. What people see (the view, the status line, the pages) and `verdict` in results.json are this
verdict, so that none of them is calmer than another.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from sms_online.row_types import Residuals
from sms_online.verdict import reasons, sample_reasons
from sms_online.verdict.evidence import Evidence
from sms_online.verdict.torque_noise import NOISY, noisier
from sms_online.verdict.trust import Reason, Trust


def judge(evidence: Evidence) -> Trust:
    """The verdict on a session."""
    trust = _judged(evidence)
    if not evidence.diagnosed:
        return trust
    return replace(trust, grounds=tuple(replace(each, then=_behind_diagnosis(each.then)) for each in trust.grounds))


def _behind_diagnosis(then: str) -> str:
    """A next step that does not send a person back to where the description comes from."""
    instead = reasons.DIAGNOSED if then.endswith(reasons.DIAGNOSE) else ""
    return reasons.without_diagnosis(then) + instead


def _judged(evidence: Evidence) -> Trust:
    """The same, of a system that no diagnosis has described.

    What has been shown to be wrong counts from when it is shown. Residuals of an estimate that has not converged show
    nothing: it was made of other, poorer rows.
    """
    if reasons.lacking(evidence.discrepancies) or reasons.unexplained_torques(evidence.residual):
        # What the model lacks looks like errors of calibration as well.
        evidence = replace(evidence, miscalibrated=())
    if _weak_throughout(evidence.residual):
        # Nothing is known of the parameters, so nothing is known to be missing beside them.
        evidence = replace(evidence, discrepancies=(), alarm=None)
    alarmed = _alarmed(evidence)
    wrong = _wrong(evidence, alarmed)
    # Faults of the samples come before what they may have done to the estimate.
    samples, few = sample_reasons.of_samples(evidence), sample_reasons.outliers(evidence.outliers, few=True)
    weak = reasons.weak_torques(evidence.residual)
    if wrong:
        return Trust("doubt", (*samples, *wrong, *few, *weak, *_cautions(evidence)), grave=True)
    samples += few
    if never := [name for name, since in evidence.silent.items() if math.isinf(since)]:
        return Trust("not yet", (sample_reasons.never_received(never), *samples, *weak, *_cautions(evidence)))
    if evidence.unconverged:
        # What keeps samples from coming is to be mended before anybody moves more.
        first = [*sample_reasons.silenced(evidence.silent), *sample_reasons.troubled(evidence.troubles)]
        rest = _cautions(replace(evidence, troubles=()))
        unscaled = reasons.unscaled(evidence.unscaled) if evidence.unscaled else None
        why = [unscaled or reasons.unconverged(evidence.unconverged), *samples]
        # Where nothing is determined, the weak motion is why.
        why = [*why, *weak] if evidence.determined[0] else [*weak, *why]
        return Trust("not yet", (*first, *why, *rest))
    # An alarm that is not grave is one that coloured noise may have caused.
    cautions = (*samples, *weak, *alarmed, *reasons.moving(evidence.suspected), *_cautions(evidence))
    cautions = (*(cautions or reasons.inconsistent(evidence.consistency)), *reasons.unwatched(evidence.unwatched))
    return Trust("doubt", cautions) if cautions else Trust("trust", tuple(reasons.grounds(evidence)))


def _wrong(evidence: Evidence, alarmed: Sequence[Reason]) -> list[Reason]:
    """Reasons why the numbers are wrong by more than any error bar says, the strongest first."""
    converged, residual = not evidence.unconverged, _lasting(evidence)
    scaled = reasons.scaled(evidence.comparison)
    # A factor with a known cause explains the rest; without one, what the model lacks may have made it.
    out = [*(scaled if evidence.comparison.cause else ()), *reasons.lacking(evidence.discrepancies)]
    if converged:
        rows = [*reasons.unexplained_torques(residual), *reasons.beyond_limit(residual)]
        rows = reasons.or_short(rows, residual) if evidence.short else rows
        out += reasons.or_drifting(rows) if evidence.still else rows
        out += [each for each in (*evidence.miscalibrated, *evidence.weaknesses) if each.grave]
    out += _unnamed(evidence, noisy=False)
    out += [each for each in alarmed if each.grave]
    out += () if evidence.comparison.cause else scaled
    if converged:
        out += [*reasons.negative(evidence.negative), *reasons.disputed(evidence.disputed)]
    return out


def _weak_throughout(residual: Residuals) -> bool:
    """Whether all torques are noise for the most part."""
    torques = [rows for rows in residual.values() if rows.relative is not None]
    return bool(torques) and all(rows.weak for rows in torques)


def _alarmed(evidence: Evidence) -> list[Reason]:
    """The sequential test's alarm, where no discrepancy of the running diagnosis says the same."""
    said = evidence.alarm in evidence.noisy or any(each.unexplained for each in evidence.discrepancies)
    if evidence.alarm is None or said:
        return []
    alarm = reasons.more_than_noise(evidence.alarm, evidence.coloured)
    return [replace(alarm, grave=alarm.grave and evidence.alarm not in _biased(evidence))]


def _unnamed(evidence: Evidence, noisy: bool) -> list[Reason]:
    """Residuals beyond their noise for no known reason, of rows that noise alone may put there or of all others."""
    found, of_noise = reasons.unnamed(evidence.discrepancies), {*evidence.noisy, *_biased(evidence)}
    return [each for each in found if noisy != of_noise.isdisjoint(each.places)]


def _biased(evidence: Evidence) -> set[str]:
    """Rows that all in all leave no more than noise, where noise in the columns biases the estimate.

    Windows were tested with an estimate that was biased further, from fewer rows.
    """
    if not evidence.attenuated:
        return set()
    return {row for row, each in evidence.residual.items() if each.noise_alone}


def _lasting(evidence: Evidence) -> Residuals:
    """Residuals without those of noisy torques."""
    return {row: each for row, each in evidence.residual.items() if row not in evidence.noisy}


def _cautions(evidence: Evidence) -> list[Reason]:
    """What makes some of the numbers, or their error bars, worse than they look."""
    out = [*reasons.in_series(evidence.repeated), *(each for each in evidence.miscalibrated if not each.grave)]
    out += [*sample_reasons.troubled(evidence.troubles), *(each for each in evidence.weaknesses if not each.grave)]
    out += noisier(evidence.noisy, evidence.residual)
    out += [replace(each, grave=False) for each in _unnamed(evidence, noisy=True)]
    out += [*reasons.beyond_noise(_lasting(evidence)), *reasons.apart(evidence.comparison)]
    out += [*reasons.undetermined(evidence.undetermined), *reasons.attenuated(evidence.attenuated)]
    out += reasons.undecided_changes(evidence.undecided)
    out += reasons.passed(evidence.discrepancies)
    return out + reasons.inconsistent_physics(evidence.distance)


def judge_diagnosis(
    verdict: str,
    effects: Sequence[str],
    row: str | None,
    after: Trust,
    near: bool = False,
    either: Sequence[Reason] = (),
    learned: bool = False,
) -> Trust:
    """The verdict on a diagnosed capture.

    verdict: `clean`, `named` or `unexplained`. effects: what was named, `name@where`. row: type of the rows that
    what is not explained acts on. after: of the session with what was named. near: whether effects that are named
    in an unexplained session leave little of it. either: what was named that may as well be elsewhere, and scales
    the parameters differently there. learned: curves were tried as well.
    """
    if verdict == "clean":
        return after
    if verdict == "unexplained" and at_noise(after) and not effects:
        noisy = next(reason for reason in after.grounds if reason.mark == NOISY)
        text = "no known effect explains what is left, which does not last: noise of torques, or a fast force"
        return Trust("doubt", (Reason(text, False, noisy.places, "unexplained", then=noisy.then), *after.grounds))
    found = _unexplained(effects, row, near, learned) if verdict == "unexplained" else _named(effects, after, either)
    # The session with what was named says so too.
    rest = [reason for reason in after.grounds if not (either and reason.mark == reasons.UNDECIDED)]
    rest = rest if after.level != "trust" else []
    return Trust("doubt", (*found, *rest), grave=found[0].grave)


def at_noise(trust: Trust) -> bool:
    """Whether rows leave more than their predicted noise, but nothing that lasts: torques are noisier."""
    return not trust.grave and any(reason.mark == NOISY for reason in trust.grounds)


def _unexplained(effects: Sequence[str], row: str | None, near: bool, learned: bool) -> list[Reason]:
    """Reasons where no known effect explains what acts, or not all of it."""
    where = "" if row is None else f" on {row}"
    like = reasons.listed(effects)
    text = f"a force{where} that no known effect explains"
    if near:
        text = f"{like} explain{'s' * (len(effects) == 1)} most of what acts{where}, not all"
    then = reasons.NO_CURVE if learned else reasons.DESCRIBE
    found = [Reason(text, True, () if row is None else (row,), "unexplained", then=then)]
    # These are no findings, so they are not listed one by one.
    return found if near or not effects else [*found, Reason(f"some of it looks like {like}", True)]


def _named(effects: Sequence[str], after: Trust, either: Sequence[Reason]) -> list[Reason]:
    """What the system file lacks, and whether the parameters can be trusted with it."""
    each = [
        Reason(f"it lacks {effect}", after.grave, (reasons.place(effect),), reasons.kind(effect)) for effect in effects
    ]
    what, them = (effects[0], "it") if len(effects) == 1 else (f"{len(effects)} effects", "them")
    unsure = after.grave or after.level == "not yet" or either or at_noise(after)
    trusted = f"; the parameters are trusted with {them}" + (
        ", except as listed below" if after.level == "doubt" else ""
    )
    text = f"the system file lacks {what}" + ("" if unsure else trusted)
    # What else is to be done comes first.
    then = "" if after.grave or after.next_step else reasons.GO_ON_WITH
    found = (
        [replace(each[0], text=text, then=then)] if len(each) == 1 else [Reason(text, after.grave, then=then), *each]
    )
    return [*(replace(reason, grave=after.grave) for reason in either), *found]
