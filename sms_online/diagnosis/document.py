"""A diagnosis as one document, diagnosis.json: verdict, effects with their doubt, residuals before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from sms_online.description.schema import Effect
from sms_online.diagnosis.attempt import Part
from sms_online.diagnosis.candidate import Finding
from sms_online.diagnosis.drifts import sentence, summary_of, trust_with
from sms_online.diagnosis.hypothesis import LARGEST_SHARE_LEFT
from sms_online.diagnosis.posterior import coefficients, posterior
from sms_online.diagnosis.reported import Coefficients
from sms_online.diagnosis.search import Search
from sms_online.diagnosis.torque_zeros import HELD_OUT
from sms_online.effects.catalogue import ENTRIES, declarable, either, in_words, traits_of
from sms_online.result import event_document, residual_document, result_of
from sms_online.row_types import Residual
from sms_online.threads import one_blas_thread
from sms_online.verdict.evidence import Evidence
from sms_online.verdict.gather import evidence_of
from sms_online.verdict.judge import at_noise, judge, judge_diagnosis
from sms_online.verdict.judged import JudgedEvaluation, evaluated
from sms_online.verdict.reasons import MEASURE_SLOPES, REPLAY_WHOLE, undecided, without_diagnosis
from sms_online.verdict.trust import Reason, Trust

SCHEMA = "sms-online/diagnosis/1"
# A torque is explained better where less is left of it by this share.
LEAST_FALL = 0.1
# What was found by comparing whole descriptions competes with no columns.
NO_RIVAL = {"next": None, "next_held_out_improvement": None}

# Errors of reconstructed coordinates are correlated: measured on arms of two links, see docs/validation/diagnosis.md.
ROUGH_BARS = "parameters are of reconstructed coordinates: errors may be three times the error bars"
INTERRUPTED = "the search was interrupted, and has not decided what the model lacks"
RUN_TO_THE_END = "let the diagnosis run to its end"


@one_blas_thread()
def diagnosis_document(
    diagnosis: Search, warnings: Sequence[str] = (), truth: Mapping[str, float] | None = None
) -> dict[str, Any]:
    """diagnosis.json.

    truth: true values of physical parameters by name, of a simulated capture; they enter this report alone.
    """
    before, after = diagnosis.before, diagnosis.after
    sessions = {"before": evaluated(diagnosis.estimator_before), "after": evaluated(diagnosis.estimator_after)}
    results = {name: result_of(session, truth).document() for name, session in sessions.items()}
    unexplained, given = diagnosis.unexplained, diagnosis.by_rows
    apart = given or diagnosis.of_reconstructed
    return {
        "schema": SCHEMA,
        "verdict": diagnosis.verdict,
        "partial": diagnosis.partial,
        "summary": summary(diagnosis),
        "judgement": trust_of(diagnosis, sessions["after"]).document(),
        "mistakes": [
            {
                "name": mistake.name,
                "where": mistake.where,
                "sentence": mistake.sentence,
                "next_step": mistake.step,
                "or_else": list(mistake.or_else),
            }
            for mistake in diagnosis.mistakes
        ],
        "torque_zeros": [
            {
                "channel": zero.channel,
                "capture": None if zero.capture == HELD_OUT else zero.capture + 1,
                "offset": zero.offset,
                "std": zero.std,
                "unit": zero.unit,
                "sentence": zero.sentence,
            }
            for zero in diagnosis.zeros
        ],
        "changes": [{**event_document(each.event), "sentence": each.sentence} for each in diagnosis.changes],
        "calibration": [
            {**each.document(), "sentence": str(each), "next_step": each.advice} for each in diagnosis.calibration
        ],
        "effects": effects_document(diagnosis),
        "drifts": [{**drift.document(), "sentence": sentence(drift)} for drift in diagnosis.drifts],
        "steps": [
            {"taken": step.taken, "effects": list(step.effects), "holdout": step.relative} for step in diagnosis.steps
        ],
        **{
            name: {
                "fit": residual_document(_part(state.fit)),
                "holdout": residual_document(_part(state.holdout)),
                "limit": {row: test.limit for row, test in state.test.items()},
                "parameters": [p.document() for p in posterior(attempt, chosen, truth)]
                if given
                else results[name]["parameters"],
            }
            for name, state, attempt, chosen in (
                ("before", before, diagnosis.described, []),
                ("after", after, diagnosis.attempt, diagnosis.chosen),
            )
        },
        "unexplained": None
        if unexplained is None
        else {
            "row": unexplained.row,
            "speed": unexplained.speed,
            "variable": unexplained.variable,
            "share": unexplained.share,
            "at": unexplained.at.tolist(),
            "force": unexplained.force.tolist(),
        },
        "candidates": [
            {
                "name": ranked.candidate.effect.name,
                "where": ranked.candidate.effect.where,
                "gain": ranked.gain,
                "explained": ranked.explained,
            }
            for ranked in diagnosis.ranking
        ],
        "warnings": [
            *warnings,
            *(zero.sentence for zero in diagnosis.zeros),
            *(change.sentence for change in diagnosis.changes),
            # Those of a session are of its parameters, which are not those reported where these come from rows.
            *(_after(diagnosis, sessions["after"]) if apart else sessions["after"]).warnings,
        ],
    }


def _after(diagnosis: Search, session: JudgedEvaluation) -> Trust:
    """May the parameters after be trusted? What to do next is no diagnosis: this is one."""
    trust = session.trust
    if diagnosis.by_rows or diagnosis.of_reconstructed:
        trust = judge(_evidence_after(diagnosis, session))
    return replace(trust, grounds=tuple(replace(each, then=without_diagnosis(each.then)) for each in trust.grounds))


def _evidence_after(diagnosis: Search, session: JudgedEvaluation) -> Evidence:
    """Where parameters are of rows of the diagnosis, see `posterior`, or of coordinates that no sensor reads."""
    rough = (Reason(ROUGH_BARS, False, then=MEASURE_SLOPES),) if diagnosis.of_reconstructed else ()
    if diagnosis.by_rows:
        known = [p.determined for p in posterior(diagnosis.attempt, diagnosis.chosen)]
        return Evidence((sum(known), len(known)), residual=_part(diagnosis.after.fit), weaknesses=rough)
    # What such coordinates seem to be off by, or lack, is no sensor's fault.
    evidence = replace(evidence_of(session, (), ()), lost=0.0, jitters={}, coloured={}, miscalibrated=())
    return replace(evidence, weaknesses=rough)


def trust_of(diagnosis: Search, after: JudgedEvaluation | None = None) -> Trust:
    """May the parameters after be trusted, and the system file?

    after: the evaluation of the session with what was found, where it is at hand.
    """
    trust = _of_part(diagnosis, evaluated(diagnosis.estimator_after) if after is None else after)
    if not diagnosis.changes:
        return trust
    jumps = [Reason(each.sentence, False, each.places, "a jump", then=REPLAY_WHOLE) for each in diagnosis.changes]
    return Trust("doubt", (*jumps, *(trust.grounds if trust.level != "trust" else ())), grave=trust.grave)


def _of_part(diagnosis: Search, after: JudgedEvaluation) -> Trust:
    """May they be trusted for the part that was diagnosed?"""
    effects = [effect.key for effect in _named(diagnosis)]
    row = None if diagnosis.unexplained is None else diagnosis.unexplained.row
    rest, learned = _after(diagnosis, after), diagnosis.attempt.case.learned
    if _undecided_yet(diagnosis):
        return Trust("doubt", (Reason(INTERRUPTED, True, then=RUN_TO_THE_END), *rest.grounds), grave=True)
    if diagnosis.drifts:
        if diagnosis.estimator_after is not diagnosis.estimator_before:
            rest = trust_with(diagnosis.drifts, rest)
        if not diagnosis.mistakes:
            return rest
    if not diagnosis.mistakes and not effects and diagnosis.verdict == "named":
        off = tuple(Reason(f"{each}: beyond its tolerance", False, then=each.advice) for each in diagnosis.calibration)
        return rest if rest.level != "trust" else Trust("doubt", off)
    if not diagnosis.mistakes:
        return judge_diagnosis(diagnosis.verdict, effects, row, rest, _near(diagnosis), _undecided(diagnosis), learned)
    if effects or row is not None:
        rest = judge_diagnosis(diagnosis.verdict, effects, row, rest, _near(diagnosis), _undecided(diagnosis), learned)
    # The numbers are those of corrected samples: as recorded, or as described, they would be wrong without limit.
    wrong = [Reason(m.sentence, True, tuple(m.where.split(", ")), "a mistake", then=m.step) for m in diagnosis.mistakes]
    return Trust("doubt", (*wrong, *(rest.grounds if rest.level != "trust" else ())), grave=True)


def summary(diagnosis: Search) -> str:
    """The verdict in a sentence, after one for each jump of parameters and each mistake."""
    jumps = "".join(f"{each.sentence[:1].upper()}{each.sentence[1:]}. " for each in diagnosis.changes)
    return f"{jumps}{_of_search(diagnosis)}"


def _of_search(diagnosis: Search) -> str:
    """The same of the part that was diagnosed."""
    said = _whole(diagnosis)
    if not diagnosis.partial:
        return said
    if _undecided_yet(diagnosis):
        # What was not tried yet is not ruled out.
        found = ", ".join(_named_in_words(diagnosis, effect) for effect in _named(diagnosis))
        said = f"Found by then: {found or 'nothing'}; no other effect is ruled out."
    return f"Partial, the search was interrupted. {said}"


def _undecided_yet(diagnosis: Search) -> bool:
    """Whether the search ended before it could know what the model lacks."""
    return diagnosis.partial and diagnosis.verdict == "unexplained"


def _whole(diagnosis: Search) -> str:
    wrong = ["".join((m.sentence[:1].upper(), m.sentence[1:], ".")) for m in diagnosis.mistakes]
    for k, mistake in enumerate(diagnosis.mistakes):
        if mistake.or_else:
            wrong[k] = f"{wrong[k][:-1]}, or {'; or '.join(mistake.or_else)}: these data cannot decide it."
    wrong += [f"The description is off beyond its tolerance: {each}." for each in diagnosis.calibration]
    if wrong and diagnosis.verdict == "named" and not _named(diagnosis) and not diagnosis.drifts:
        return " ".join((*wrong, "With that corrected the residual is noise."))
    return " ".join((*wrong, *(["With that corrected:"] if wrong else []), _of_effects(diagnosis)))


def _of_effects(diagnosis: Search) -> str:
    """What is missing in a sentence."""
    if diagnosis.drifts:
        return summary_of(diagnosis.drifts)
    if diagnosis.verdict == "clean":
        return "The residual is noise: the model explains the capture."
    if diagnosis.verdict == "unexplained" and diagnosis.unexplained is None:
        reason = _after(diagnosis, evaluated(diagnosis.estimator_after)).reasons[0]
        return f"No effect of the catalogue was detected in the residual, but {reason}."
    keys = [_named_in_words(diagnosis, effect) for effect in _named(diagnosis)]
    before, after = diagnosis.before.holdout.whitened, diagnosis.after.holdout.whitened
    row = max(before, key=lambda name: before[name] ** 2 - after[name] ** 2)
    fall = f"from {_times(before[row])} to {_times(after[row])} times noise"
    falls = f"the residual of {row} falls {fall} on held-out data"
    most = max((finding.improvement for finding in diagnosis.findings), default=0.0)
    if most > LEAST_FALL and not any(each.beyond for each in diagnosis.before.test.values()):
        # A slow force is a small part of each row, and clear once what neighbouring rows have in common is taken off.
        falls = f"the whitened residual of held-out rows falls by {100.0 * most:.0f} %"
    if diagnosis.verdict == "named":
        return f"The model lacks {', '.join(keys)}: with {'them' if len(keys) > 1 else 'it'} {falls}."
    if not keys and at_noise(_after(diagnosis, evaluated(diagnosis.estimator_after))):
        return "No known effect explains what is left, which does not last: noise of torques, or a fast force."
    unexplained = diagnosis.unexplained
    assert unexplained is not None
    rest = f"acts on {unexplained.row} (seen in {unexplained.speed}) and depends on {unexplained.variable}"
    if _near(diagnosis):
        explain = f"explain{'s' * (len(keys) == 1)} most of what the model lacks, not all"
        return f"{', '.join(keys)} {explain}: {falls}, and what is left {rest}."
    tried = f" {_nearest(diagnosis, keys)}" if keys else ""
    return f"The model lacks something that no known effect explains: it {rest}.{tried}"


def _nearest(diagnosis: Search, keys: Sequence[str]) -> str:
    """What known effects do where they leave much: they may explain torques all the same."""
    before, after = diagnosis.before.holdout.relative, diagnosis.after.holdout.relative
    falls = [
        f"from {100.0 * before[joint]:.2g} to {100.0 * left:.2g} % of {joint}"
        for joint, left in after.items()
        if joint in before and left < (1.0 - LEAST_FALL) * before[joint]
    ]
    if not falls:
        share = f"{100.0 * (1.0 - diagnosis.left):.0f} %" if diagnosis.left < 1.0 else "none"
        return f"The nearest known effects ({', '.join(keys)}) explain {share} of it."
    return f"With {', '.join(keys)} what is left of the torques on held-out data falls {', '.join(falls)}."


def _near(diagnosis: Search) -> bool:
    """Whether the effects named leave little, though it is no noise and no error of their laws."""
    return bool(_named(diagnosis)) and diagnosis.left <= LARGEST_SHARE_LEFT


def _times(value: float) -> str:
    """Three digits, without an exponent."""
    return f"{value:.3g}" if value < 1000.0 else f"{value:,.0f}"


def _named(diagnosis: Search) -> list[Effect]:
    found = [finding.candidate.effect for finding in diagnosis.findings]
    return [*(each.effect for each in diagnosis.late), *_exact(diagnosis), *found]


def _exact(diagnosis: Search) -> list[Effect]:
    """Kinematics of links that were found by comparing whole descriptions."""
    known = [*diagnosis.described.system.effects, *(found.effect for found in diagnosis.late)]
    return [effect for effect in diagnosis.attempt.system.effects if effect not in known]


def _named_in_words(diagnosis: Search, named: Effect) -> str:
    other = either(named, diagnosis.after.system)
    return f"{named.name} at {named.where}" + (f" or {other}" if other else "")


def _part(part: Part) -> dict[str, Residual]:
    return {row: Residual(part.relative.get(row), whitened) for row, whitened in part.whitened.items()}


def effects_document(diagnosis: Search) -> list[dict[str, Any]]:
    """The effects found, as diagnosis.json holds them."""
    return [_effect(diagnosis, finding) for finding in diagnosis.findings] + _by_comparison(diagnosis)


def _effect(diagnosis: Search, finding: Finding) -> dict[str, Any]:
    effect = finding.candidate.effect
    found, units = coefficients(diagnosis, finding), declarable(ENTRIES[effect.name], diagnosis.after.system)
    other = either(effect, diagnosis.after.system)
    alike = [*([f"{effect.name}@{other}"] if other else []), *finding.ambiguous]
    units |= {p.quantity: p.unit for p in finding.candidate.parameters if p.quantity in units}
    rival = finding.rival
    return _entry(
        effect,
        {name: {"estimate": value, "std": std, "unit": units.get(name, "")} for name, (value, std) in found.items()},
        _said(diagnosis, effect, found),
        alike,
        {
            "gain": finding.gain.gain,
            "limit": finding.limit,
            "held_out_improvement": finding.improvement,
            "next": None if rival is None else rival.key,
            "next_held_out_improvement": None if rival is None else rival.improvement,
        },
    )


def _entry(
    effect: Effect, coefficients: dict[str, Any], sentence: str, ambiguous: Sequence[str], evidence: dict[str, Any]
) -> dict[str, Any]:
    return {
        "name": effect.name,
        "where": effect.where,
        "coefficients": coefficients,
        "sentence": sentence,
        "ambiguous_with": list(ambiguous),
        "separated_by": ENTRIES[effect.name].separated_by if ambiguous else None,
        "evidence": evidence,
    }


def _said(diagnosis: Search, effect: Effect, found: Coefficients) -> str:
    if traits_of(effect).learned:
        return _curve_in_words(diagnosis, effect)
    return in_words(effect, diagnosis.after.system, {name: value for name, (value, _) in found.items()})


def _curve_in_words(diagnosis: Search, curve: Effect) -> str:
    """What a curve takes off the torque of its joint, blocks predicted from the others."""
    relative = [diagnosis.before.holdout.relative, *(step.relative for step in diagnosis.steps)]
    taken = [step.taken for step in diagnosis.steps].index(curve.key)
    before, after = (relative[k].get(curve.where, 0.0) for k in (taken, taken + 1))
    over = f"this curve over the {curve.over} of {curve.where}"
    return (
        f"no known law; {over} takes what is left of the torque from {100.0 * before:.2g} % to {100.0 * after:.2g} % "
        "on held-out data"
    )


def _undecided(diagnosis: Search) -> list[Reason]:
    """Findings that may as well be their opposite elsewhere."""
    system = diagnosis.after.system
    found = [(finding, either(finding.candidate.effect, system)) for finding in diagnosis.findings]
    return [
        undecided(_said(diagnosis, f.candidate.effect, coefficients(diagnosis, f)), f.candidate.effect.where, other)
        for f, other in found
        if other
    ]


def _by_comparison(diagnosis: Search) -> list[dict[str, Any]]:
    """Effects that replace all rows, found by comparing whole descriptions: late sensors, kinematics of links."""
    late = [
        _entry(
            found.effect,
            {"corner": {"estimate": found.effect.coefficients["corner"], "std": found.std, "unit": "Hz"}},
            "",
            found.ambiguous,
            {"gain": found.gain, "limit": found.limit, "held_out_improvement": found.improvement, **NO_RIVAL},
        )
        for found in diagnosis.late
    ]
    gain = diagnosis.before.excess * (1.0 - diagnosis.left)
    evidence = {"gain": gain, "limit": 0.0, "held_out_improvement": None, **NO_RIVAL}
    return [*late, *(_entry(effect, {}, "", (), evidence) for effect in _exact(diagnosis))]
