"""The reasons to doubt an estimate: when each counts, what it says, and what to do about it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from sms_online.model.parameters import ELASTIC
from sms_online.nominal import NominalComparison
from sms_online.pipeline.tracker_bank import Suspected
from sms_online.row_types import LARGEST_RESIDUAL, NOISE_WHITENED, Residuals
from sms_online.tracker_results import Consistency
from sms_online.verdict.evidence import Discrepancy, Dispute, Evidence
from sms_online.verdict.trust import Reason

# Rows that hold this many times their predicted deviation distort parameters by more than the reported deviations.
LARGEST_WHITENED = 3.0
# Share of a torque that friction nobody described leaves; more without rows that say it is noise is no green.
NOISE_RESIDUAL = 0.1
# Up to here a multiple of the noise is not given: it is rounded to one, or samples are exact and there is no noise.
JUST_NOISE = 1.05
# Further from the nearest physically consistent parameters than this, in standard deviations, noise brings no estimate.
LARGEST_DISTANCE = 3.0
# A session of so many seconds in which no drift is watched for may hold one that matters.
LONGEST_UNWATCHED = 60.0
# Names in a sentence; the others are counted.
NAMED = 2
# Without a spring, a mass or a rigidity nobody simulates the arm: green needs them, by the ends of their names.
VITAL = ("mass", "mass_per_length", *ELASTIC)
# Word for what may be at either of two places.
UNDECIDED = "ambiguous place"
# What to do next.
DIAGNOSE = "run `sms-online diagnose` on the recording"
DIAGNOSED = (
    "a diagnosis has described this system already: check it on another run, `sms-online validate`, "
    "or let a curve be learned of what is left, `sms-online diagnose --learn`"
)
ADD_EFFECT = "run `sms-online diagnose` and replay with the system.toml that it writes"
OR_ADOPT = f"{ADD_EFFECT}, or use --adopt"
THEN_DIAGNOSE = ", then run `sms-online diagnose`"
IF_NOTHING = f"{DIAGNOSE}; where it finds nothing, and "
GO_ON_WITH = "go on with the system.toml that was written, and check it on another run: `sms-online validate`"
REPLAY_WHOLE = "replay the whole capture with the system.toml that was written: a session goes on behind the jump"
DESCRIBE = "describe what acts there, or let a curve be learned: `sms-online diagnose --learn`"
NO_CURVE = "no learned curve explains it either: look at what acts there, and at the sensors of these rows"
CHECK_TORQUE = f"check sign, unit and gear ratio of that torque{THEN_DIAGNOSE}"
OR_WEAK = f"where the motion was small, move faster and further; else {CHECK_TORQUE}"
CHECK_ROWS = f"check geometry, clocks and stated noise of the sensors in these rows{THEN_DIAGNOSE}"
CHECK_SCALE = "check unit and gear of the torques, or weigh one part and state it under [known]"
CHECK_PRIOR = "check that prior, and run `sms-online diagnose` for what the model lacks in these rows"
CHECK_COLOUR = "look at what filters that sensor, or log its samples as they are"
STATE_HELD = f"state `hold` of held torques{THEN_DIAGNOSE}"
MEASURE_SLOPES = "measure slopes of the links too: the momentum balance then includes the tolerances"
STATE_HOLD = "state hold = true under [[sensor]] of the torques"
WEIGH = "check torque constants and gear ratios, or weigh one part and state it under [known]"
FOLLOW = "replay it with `--tracker kalman:drift=learned` (tracker = kalman, drift = learned)"
WALK = "replay it with `--tracker kalman:drift=random_walk,share=0.001`"
LONGER = "record for longer: so few windows do not show whether it is noise of the torques or a force; else "
OR_DRIFTS = f"{FOLLOW}, if a parameter may have drifted; else "
GO_ON = "record for longer: a drift is followed once it is certain; then run `sms-online diagnose`"
NO_KNOWN = "leave `[known]` out, so that joint_1's torque gives the scale, or weigh a heavier part"
MOVE = "move all joints, faster and over a larger range, and long enough"


def without_diagnosis(then: str) -> str:
    """A next step less the diagnosis that it asks for."""
    return then.removesuffix(THEN_DIAGNOSE).removesuffix(DIAGNOSE).removeprefix(IF_NOTHING)


def unconverged(why: str) -> Reason:
    """An estimate that will still move by more than its error bars."""
    return Reason(why, False, then=MOVE)


def unscaled(names: Sequence[str]) -> Reason:
    """Known values whose effect on the rows noise hides: ratios of parameters are determined, and no scale."""
    text = f"ratios of parameters are determined, not their scale: noise hides what {listed(names)} adds to the rows"
    return Reason(text, False, then=NO_KNOWN)


def scaled(comparison: NominalComparison) -> list[Reason]:
    """One factor that everything is off by, which rows cannot show."""
    factor = comparison.common
    if factor is None:
        return []
    cause = f": {comparison.cause}" if comparison.cause else ""
    text = f"everything is {factor:.3g} × its description{cause}"
    means = f"all parameters are about {factor:.3g} × what the system file states{cause}"
    return [Reason(text, True, (), "", f"{means}; no residual shows such a factor", CHECK_SCALE)]


def lacking(discrepancies: Iterable[Discrepancy]) -> list[Reason]:
    """Effects that the model is known to lack, and mistakes that samples hold."""
    out = []
    for each in discrepancies:
        out += [Reason(mistake, True, (), "mistake", then=DIAGNOSE) for mistake in each.mistakes]
        if each.verdict == "named" and not each.adopted:
            places = tuple(place(effect) for effect in each.effects)
            mark = ", ".join(dict.fromkeys(kind(effect) for effect in each.effects))
            then = ADD_EFFECT if each.refused else OR_ADOPT
            out.append(Reason(f"the model lacks {listed(each.effects)}", True, places, mark, then=then))
    return out


def unnamed(discrepancies: Iterable[Discrepancy]) -> list[Reason]:
    """Residuals that exceed their predicted noise, for a reason that is not known."""
    out = []
    for each in discrepancies:
        if each.verdict in ("noticed", "unexplained"):
            why = "not named yet" if each.verdict == "noticed" else "no known effect explains it"
            why += f", nearest {listed(each.effects)}" if each.effects else ""
            text = f"the residual of {each.row} exceeds its predicted noise since {each.noticed:.1f} s, {why}"
            out.append(Reason(text, True, (each.row,), "exceeds noise", then=DIAGNOSE))
    return out


def passed(discrepancies: Iterable[Discrepancy]) -> list[Reason]:
    """Residuals that exceeded their predicted noise for a time."""
    return [
        Reason(f"the residual of {each.row} exceeded its predicted noise for a time", False, then=DIAGNOSE)
        for each in discrepancies
        if each.verdict == "passed"
    ]


def unexplained_torques(residual: Residuals) -> list[Reason]:
    """Torques that the model does not explain, the worst first."""
    shares = {name: share for name, rows in residual.items() if (share := rows.relative) is not None}
    out = []
    for name, share in sorted(shares.items(), key=lambda item: -item[1]):
        if residual[name].unexplained:
            # A fit that leaves more than there is explains nothing.
            much = f"{100.0 * min(1.0, share):.0f} %"
            percent = f"{much} of the torque or force of {name} is not explained"
            means = "the model lacks an effect there, and the parameters are biased by its absence"
            mark = f"{much} unexplained"
            then = CHECK_TORQUE if share < 1.0 else OR_WEAK
            out.append(Reason(percent, True, (name,), mark, f"{percent}: {means}", then))
    return out


def weak_torques(residual: Residuals) -> list[Reason]:
    """Torques that are little more than their noise: the motion is too weak, and nothing is known to be missing."""
    weak = {name: rows.relative for name, rows in residual.items() if rows.relative is not None and rows.weak}
    if not weak:
        return []
    most = max(weak, key=lambda name: weak[name])
    percent = 100.0 * min(1.0, weak[most])
    text = f"weak data: {percent:.0f} % of the torque or force of {listed(sorted(weak))} is noise"
    return [Reason(text, False, tuple(weak), "weak data", then=MOVE)]


def beyond_limit(residual: Residuals) -> list[Reason]:
    """The rows that are furthest beyond their noise, where that is far."""
    worst, noise = _worst(residual)
    if worst is None or noise <= LARGEST_WHITENED:
        return []
    full = (
        f"the residual of {worst} is {noise:.0f} times its predicted noise: the model or the samples are wrong there, "
        "by more than error bars can express"
    )
    mark = f"{noise:.0f} × noise"
    return [Reason(f"the residual of {worst} is {mark}", True, (worst,), mark, full, CHECK_ROWS)]


def or_short(found: Sequence[Reason], residual: Residuals) -> list[Reason]:
    """The same of a session too short to show whether it is noise, where all torques are nearly explained."""
    if any(rows.relative is not None and rows.relative > NOISE_RESIDUAL for rows in residual.values()):
        return list(found)
    return [replace(each, then=LONGER + each.then) for each in found]


def or_drifting(found: Sequence[Reason]) -> list[Reason]:
    """The same where the tracker lets no parameter move: one that drifts leaves as much in the rows."""
    return [replace(each, then=OR_DRIFTS + each.then) for each in found]


def beyond_noise(residual: Residuals) -> list[Reason]:
    """Rows that hold somewhat more than noise, and torques that are not all explained."""
    out = []
    worst, noise = _worst(residual)
    if worst is not None and NOISE_WHITENED < noise <= LARGEST_WHITENED:
        mark = f"{noise:.2g} × noise"
        out.append(Reason(f"the residual of {worst} is {mark}", False, (worst,), mark, then=DIAGNOSE))
    for name, rows in residual.items():
        unknown = rows.whitened is None or rows.whitened > NOISE_WHITENED
        if rows.relative is not None and NOISE_RESIDUAL < rows.relative <= LARGEST_RESIDUAL and unknown:
            percent = f"{100.0 * rows.relative:.0f} %"
            text = f"{percent} of the torque or force of {name} is not explained"
            out.append(Reason(text, False, (name,), f"{percent} unexplained", then=DIAGNOSE))
    return out


def _worst(residual: Residuals) -> tuple[str | None, float]:
    """The rows that leave most over their noise, and how much."""
    noise = {name: value for name, rows in residual.items() if (value := rows.whitened) is not None}
    worst = max(noise, key=lambda name: noise[name], default=None)
    return worst, noise[worst] if worst is not None else 0.0


def more_than_noise(row: str, coloured: Mapping[str, float]) -> Reason:
    """The alarm of a sequential test, which takes windows for independent; coloured noise makes them less so."""
    text = f"the residual of {row} exceeds its predicted noise"
    if not coloured:
        return Reason(text, True, (row,), "exceeds noise", then=DIAGNOSE)
    channel = max(coloured, key=lambda name: coloured[name])
    text += f", and the noise of {channel} is correlated over {1e3 * coloured[channel]:.2g} ms"
    return Reason(text, False, (row,), "coloured noise", then=CHECK_COLOUR)


def negative(names: Sequence[str]) -> list[Reason]:
    """Parameters that are negative and cannot be."""
    out = []
    for name in names:
        text = f"{name} is negative, which is not physical"
        full = f"{text}: the model lacks an effect, or the data are weak"
        out.append(Reason(text, True, place_of(name), "negative", full, DIAGNOSE))
    return out


def disputed(disputes: Sequence[Dispute]) -> list[Reason]:
    """Parameters that the data pull away from their prior, the furthest first."""
    out = []
    for dispute in sorted(disputes, key=lambda each: -abs(each.deviations)):
        by = "" if dispute.row is None else f", driven by the rows of {dispute.row}"
        off = f"{dispute.parameter} is {abs(dispute.deviations):.0f} σ off its prior"
        full = f"{off}{by}; the prior, the model or the samples are wrong there"
        out.append(Reason(off + by, True, place_of(dispute.parameter), "off its prior", full, CHECK_PRIOR))
    return out


def apart(comparison: NominalComparison) -> list[Reason]:
    """Parameters that are not as described."""
    return [
        Reason(
            f"{p.name} is {p.value:.3g}, described as {p.nominal:.3g}",
            False,
            place_of(p.name),
            "not as described",
            then=f"check the stated value of {p.name}, and unit and gear of the channels beside it",
        )
        for p in comparison.apart
    ]


def undetermined(names: Sequence[str]) -> list[Reason]:
    """Parameters that the data do not determine and a simulation of the arm needs."""
    vital = [name for name in names if name.endswith(VITAL)]
    if not vital:
        return []
    return [Reason(f"not determined: {listed(vital)}", False, place_of(vital[0]), "not determined", then=MOVE)]


def attenuated(names: Sequence[str]) -> list[Reason]:
    """Parameters that errors in variables bias."""
    if not names:
        return []
    text = f"sensor noise biases {listed(names)} beyond the error bar"
    full = f"sensor noise in the columns biases {', '.join(names)} by more than the error bar"
    return [Reason(text, False, full=full, then=MOVE)]


def undecided_changes(times: Sequence[float]) -> list[Reason]:
    """Changes, at times in s, that the session ended too early to decide on."""
    return [
        Reason(f"a change at {t:.1f} s came too late to be decided on: the estimates are from before it", False)
        for t in times
    ]


def undecided(said: str, where: str, other: str) -> Reason:
    """A finding at one place that may as well be its opposite at another: all parameters depend on which."""
    return Reason(said, False, (where, other), UNDECIDED, then=WEIGH)


def inconsistent_physics(distance: float) -> list[Reason]:
    """An estimate far from all physically consistent parameters; distance: in standard deviations."""
    if distance <= LARGEST_DISTANCE:
        return []
    return [Reason(f"the estimate violates physical consistency by {distance:.0f} standard deviations", False)]


def moving(suspected: Suspected | None) -> list[Reason]:
    """Parameters that seem to move: the estimate is a mean over time, and its bars are no bars of the value now."""
    if suspected is None:
        return []
    names = listed(suspected.parameters)
    moves, are = ("seem", "are") if len(suspected.parameters) > 1 else ("seems", "is")
    text = f"{names} {moves} to move since {suspected.since:.1f} s, and {are} not followed"
    where = place_of(suspected.parameters[0])
    return [Reason(text, False, where, "may move", then=GO_ON if suspected.learning else FOLLOW)]


def in_series(parameters: Sequence[str]) -> list[Reason]:
    """Parameters that jump the same way again and again: what drifts slowly is found so where spans are compared."""
    if not parameters:
        return []
    have = "have" if len(parameters) > 1 else "has"
    text = f"{listed(parameters)} {have} jumped the same way several times in a row, as what drifts does"
    return [Reason(text, False, place_of(parameters[0]), "may drift", then=WALK)]


def unwatched(duration: float) -> list[Reason]:
    """A long session, of a duration in s, in which a drift would show nowhere."""
    if duration < LONGEST_UNWATCHED:
        return []
    why = "nothing tests for drifts, which clocks of several devices mimic"
    text = f"a parameter may have drifted in {duration:.0f} s: {why}"
    return [Reason(text, False, then=FOLLOW)]


def inconsistent(consistency: Consistency | None) -> list[Reason]:
    """Rows that leave more than the tracker's error bars say, where nothing else says why."""
    if consistency is None or consistency.nis is None or consistency.nis <= consistency.upper:
        return []
    limit = f"NIS {consistency.nis:.2f}, beyond {consistency.upper:.2f}"
    text = f"all rows together leave {math.sqrt(consistency.nis):.2g} × their noise ({limit})"
    return [Reason(text, False, then=DIAGNOSE)]


def grounds(evidence: Evidence) -> list[Reason]:
    """What trust rests on, and what it does not reach to."""
    known, of = evidence.determined
    worst, noise = _worst(evidence.residual)
    shares = [share for rows in evidence.residual.values() if (share := rows.relative) is not None]
    rests = ""
    if worst is not None:
        rests = ", residual " + ("no more than noise" if noise < JUST_NOISE else f"at most {noise:.2g} × noise")
    if worst is None and shares:
        rests = f", {100.0 * max(shares):.2g} % of a torque or force unexplained"
    out = [Reason(f"{known} of {of} parameters determined{rests}", False)]
    if evidence.undetermined:
        out.append(Reason(f"not determined: {listed(evidence.undetermined)}", False))
    if evidence.scale:
        out.append(
            Reason(
                f"the common scale of all parameters rests on the torque constants, ± {100.0 * evidence.scale:.2g} %",
                False,
            )
        )
    return out


def place_of(parameter: str) -> tuple[str, ...]:
    """Where on the arm a parameter sits, from its name: `joint_i`, `link_i`, `base` or `tip`."""
    owner, _, where = parameter.rsplit(".", 1)[0].partition("@")
    if where:
        return (where,)
    owner = owner.replace("motor_", "joint_")
    return ({"spacecraft": "base", "payload": "tip"}.get(owner, owner),)


def place(effect: str) -> str:
    """Where an effect acts."""
    return effect.partition("@")[2]


def kind(effect: str) -> str:
    """An effect without its place."""
    return effect.partition("@")[0].replace("_", " ")


def listed(names: Sequence[str]) -> str:
    """The first names; of the others, how many."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more
