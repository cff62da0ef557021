"""May these numbers be trusted? One judgement of a session, of everything that is known against its estimate.

It is made here alone. What people see (the view, the status line, the pages) and `verdict` in results.json are this
judgement, so that none of them is calmer than another.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from sms_online.nominal import AS_STATED, Comparison
from sms_online.pipeline.tracker_bank import Suspected
from sms_online.tracker_results import Consistency
from sms_online.trust import Reason, Residual, Residuals, Trust

# A joint whose unexplained torque reaches this share of the measured one lacks an effect, whatever the error bars say.
LARGEST_RESIDUAL = 0.5
# Rows that hold this many times their predicted deviation distort parameters by more than the reported deviations.
LARGEST_WHITENED = 3.0
# Sessions whose model holds leave up to 1.3 of it. Rows beyond this hold more than noise, and green claims too much.
NOISE_WHITENED = 1.5
# Share of a torque that friction nobody described leaves; more without rows that say it is noise is no green.
NOISE_RESIDUAL = 0.1
# Up to here a multiple of the noise is not told: it is rounded to one, or samples are exact and there is no noise.
JUST_NOISE = 1.05
# Share of the samples that may be lost before the rest is no fair part of the motion.
LARGEST_LOSS = 0.01
# Share of a channel's samples that may be outliers before its sensor is at fault.
MANY_OUTLIERS = 1e-3
# Further from the nearest real bodies than this, in standard deviations, no noise brings an estimate.
LARGEST_DISTANCE = 3.0
# Names in a sentence; the others are counted.
NAMED = 2
# Without a spring, a mass or a rigidity nobody simulates the arm: green needs them, by the ends of their names.
VITAL = ("mass", "mass_per_length", "stiffness", "rigidity", "rigidity_y", "rigidity_z")
# Word for what may be at either of two places.
UNDECIDED = "this or the other"
# What to do next.
DIAGNOSE = "run `sms-online diagnose` on the recording"
ADD_EFFECT = "run `sms-online diagnose` and replay with the system.toml that it writes, or use --adopt"
CHECK_TORQUE = "check sign, unit and gear ratio of that torque, then run `sms-online diagnose`"
CHECK_ROWS = "check geometry, clocks and stated noise of the sensors in these rows, then run `sms-online diagnose`"
CHECK_SCALE = "check unit and gear of the torques, or weigh one part and state it under [known]"
CHECK_PRIOR = "check that prior, and run `sms-online diagnose` for what the model lacks in these rows"
CHECK_OUTLIERS = "look at that sensor: reflections and swapped markers, a loose cable, bits that flip"
CHECK_COLOUR = "look at what filters that sensor, or log its samples as they are"
STATE_HOLD = "state hold = true under [[sensor]] of the torques"
BY_SMOOTHER = 'state its rate under [[sensor]], or balance = "smoother"'
CHECK_LOSSES = "look at the faults that the session counted: a bus that is too busy, a loose cable"
WEIGH = "weigh one part and state it under [known], or measure a torque constant"
FOLLOW = "replay it with `--tracker kalman:drift=learned` (tracker = kalman, drift = learned)"
GO_ON = "record for longer: a drift is followed once it is certain; then run `sms-online diagnose`"
CHECK_DEVICE = "look at power, cable and address of what is silent, and at its table in the system file"
CHECK_TROUBLE = "see to the devices, the recording and the machine first"
MOVE = "move all joints, faster and over a larger range, and long enough"
# A session of so many seconds in which no drift is watched for may hold one that matters.
LONGEST_UNWATCHED = 60.0


@dataclass(frozen=True)
class Discrepancy:
    """Rows of a running session that leave more than noise, as diagnosed so far: see `diagnosis.episodes.Episode`.

    row: type of the rows that leave most. noticed: s. effects: what was named, `name@where`; adopted: and taken up.
    """

    row: str
    noticed: float
    verdict: str
    effects: tuple[str, ...] = ()
    adopted: bool = False


@dataclass(frozen=True)
class Dispute:
    """A parameter that the data pull further from its prior than that allows.

    deviations: of the prior, by which it is off. row: type of the rows that pull most; None where that is not known.
    """

    parameter: str
    deviations: float
    row: str | None


@dataclass(frozen=True)
class Facts:
    """What is known of a session for or against its estimate.

    determined: parameters that the data determine, and of how many. undetermined: names of the others. settling: why
    the estimate will still move by more than its error bars, empty where it will not. silent: since when, s, nothing
    has come of sources or channels; -inf where it never has. negative: names of estimates that are negative and must
    not be. pulled: names of those that noise in the columns pulls beyond their bars. alarm: type
    of the rows that the sequential test finds more than noise in, of a session without diagnosis. disputed: parameters
    that the data pull away from their prior. undecided: times, s, of changes that the session ended too early to decide
    on. distance: from the nearest real bodies, in standard deviations. comparison: with the values that the system file
    states. lost: share of the samples. outliers: by channel, the share of the samples that was left out. coloured: by
    channel, the correlation time of its noise, s. slow: rates, Hz, of sensors that are too slow for the balance.
    miscalibrated: what is off by more than the description's tolerances
    allow. troubles: of the devices, the recording and the machine of a live session, a short sentence each. weaknesses:
    of an estimate by the way it is made. suspected: parameters that seem to move, which the judged tracker does not
    follow. unwatched: s of a session in which no drift is watched for and none is followed; 0 elsewhere. consistency:
    of that tracker's rows with its error bars. scale: 1σ of the factor that all parameters have in common, where
    nothing else fixes it.
    """

    determined: tuple[int, int]
    undetermined: tuple[str, ...] = ()
    settling: str = ""
    silent: Mapping[str, float] = field(default_factory=dict)
    residual: Residuals = field(default_factory=dict)
    negative: tuple[str, ...] = ()
    pulled: tuple[str, ...] = ()
    alarm: str | None = None
    disputed: tuple[Dispute, ...] = ()
    undecided: tuple[float, ...] = ()
    distance: float = 0.0
    comparison: Comparison = AS_STATED
    lost: float = 0.0
    outliers: Mapping[str, float] = field(default_factory=dict)
    coloured: Mapping[str, float] = field(default_factory=dict)
    slow: Mapping[str, float] = field(default_factory=dict)
    discrepancies: tuple[Discrepancy, ...] = ()
    miscalibrated: tuple[Reason, ...] = ()
    troubles: tuple[str, ...] = ()
    weaknesses: tuple[str, ...] = ()
    suspected: Suspected | None = None
    unwatched: float = 0.0
    consistency: Consistency | None = None
    scale: float | None = None


def judge(facts: Facts) -> Trust:
    """The judgement of a session.

    What has been shown to be wrong counts from when it is shown. Residuals of an estimate that is still settling show
    nothing: it was made of other, poorer rows.
    """
    settled = not facts.settling
    doubts = [*_scaled(facts.comparison), *_named(facts.discrepancies)]
    if settled:
        doubts += _unexplained_torques(facts.residual)
        doubts += _loud_rows(facts.residual)
        doubts += [each for each in facts.miscalibrated if each.grave]
    doubts += _unnamed(facts.discrepancies)
    alarms = []
    if facts.alarm is not None and not any(_open(discrepancy) for discrepancy in facts.discrepancies):
        alarms = _more_than_noise(facts.alarm, facts.coloured)
        doubts += [each for each in alarms if each.grave]
    if settled:
        doubts += _negative(facts.negative)
        doubts += _disputed(facts.disputed)
    # What befell the samples comes before what that may have done to the estimate.
    losses = [*_losses(facts.lost), *_outliers(facts.outliers), *_slow(facts.slow)]
    if doubts:
        return Trust("doubt", (*losses, *doubts, *_cautions(facts)), grave=True)
    if never := [name for name, since in facts.silent.items() if math.isinf(since)]:
        text = f"nothing was received of {_listed(never)}"
        return Trust("not yet", (Reason(text, False, then=CHECK_DEVICE), *losses, *_cautions(facts)))
    if facts.settling:
        # What keeps samples from coming is to be mended before anybody moves more.
        first = [Reason(trouble, False, then=CHECK_TROUBLE) for trouble in facts.troubles]
        if facts.silent:
            text = f"nothing has come of {_listed([*facts.silent])} since {min(facts.silent.values()):.1f} s"
            first = [Reason(text, False, then=CHECK_DEVICE), *first]
        rest = _cautions(replace(facts, troubles=()))
        return Trust("not yet", (*first, Reason(facts.settling, False, then=MOVE), *losses, *rest))
    cautions = (*losses, *alarms, *_moving(facts.suspected), *_cautions(facts))
    cautions = (*(cautions or _inconsistent(facts.consistency)), *_unwatched(facts.unwatched))
    return Trust("doubt", cautions) if cautions else Trust("trust", tuple(_grounds(facts)))


def undecided(said: str, where: str, other: str) -> Reason:
    """That what is said of one place may as well be the other way at another: all parameters depend on which."""
    return Reason(said, False, (where, other), UNDECIDED, then=WEIGH)


def judge_diagnosis(
    verdict: str,
    effects: Sequence[str],
    row: str | None,
    after: Trust,
    near: bool = False,
    either: Sequence[Reason] = (),
) -> Trust:
    """The judgement of a diagnosed capture.

    verdict: `clean`, `named` or `unexplained`. effects: what was named, `name@where`. row: type of the rows that
    what is not explained acts on. after: of the session with what was named. near: whether effects that are named
    in an unexplained session leave little of it. either: what was named that may as well be elsewhere, and scales
    the parameters differently there.
    """
    if verdict == "clean":
        return after
    each = [Reason(f"it lacks {effect}", after.grave, (_place(effect),), _kind(effect)) for effect in effects]
    if verdict == "unexplained":
        where = "" if row is None else f" on {row}"
        text = f"something acts{where} that no known effect explains"
        # These are no findings, so they are not told as such one by one.
        like = [Reason(f"some of it looks like {_listed(effects)}", True)] if effects else []
        if near:
            text = f"what acts{where} is near {_listed(effects)}, but is more or something else"
            like = []
        found = [Reason(text, True, () if row is None else (row,), "unexplained"), *like]
    else:
        what, them = (effects[0], "it") if len(effects) == 1 else (f"{len(effects)} effects", "them")
        trusted = f"; trust the parameters with {them}" + (" but for what follows" if after.level == "doubt" else "")
        unsure = after.grave or after.level == "not yet" or either
        told = f"the system file lacks {what}" + ("" if unsure else trusted)
        found = [replace(each[0], text=told)] if len(each) == 1 else [Reason(told, after.grave), *each]
        found = [replace(reason, grave=after.grave) for reason in either] + found
    # The session with what was named says so too.
    rest = [reason for reason in after.grounds if not (either and reason.mark == UNDECIDED)]
    rest = rest if after.level != "trust" else []
    return Trust("doubt", (*found, *rest), grave=found[0].grave)


def _open(discrepancy: Discrepancy) -> bool:
    """Whether an alarm is this episode's. A test that alarms after an effect was taken up tells of something else."""
    return not discrepancy.adopted and discrepancy.verdict not in ("change", "drift")


def _named(discrepancies: Iterable[Discrepancy]) -> list[Reason]:
    """Effects that the model is known to lack."""
    out = []
    for discrepancy in discrepancies:
        if discrepancy.verdict == "named" and not discrepancy.adopted:
            places = tuple(_place(effect) for effect in discrepancy.effects)
            mark = ", ".join(dict.fromkeys(_kind(effect) for effect in discrepancy.effects))
            out.append(Reason(f"the model lacks {_listed(discrepancy.effects)}", True, places, mark, then=ADD_EFFECT))
    return out


def _unnamed(discrepancies: Iterable[Discrepancy]) -> list[Reason]:
    """Rows that leave more than noise, of which nobody knows why."""
    out = []
    for discrepancy in discrepancies:
        if discrepancy.verdict in ("noticed", "unexplained"):
            why = "not named yet" if discrepancy.verdict == "noticed" else "no known effect explains it"
            text = f"more than noise in the residual of {discrepancy.row} since {discrepancy.noticed:.1f} s, {why}"
            out.append(Reason(text, True, (discrepancy.row,), "more than noise", then=DIAGNOSE))
    return out


def _scaled(comparison: Comparison) -> list[Reason]:
    """That everything is off by one factor, which rows cannot show."""
    factor = comparison.common
    if factor is None:
        return []
    cause = f": {comparison.cause}" if comparison.cause else ""
    text = f"everything is {factor:.3g} × its description{cause}"
    full = (
        f"all parameters are about {factor:.3g} × what the system file states{cause}; no residual shows such a factor"
    )
    return [Reason(text, True, (), "", full, CHECK_SCALE)]


def _unexplained_torques(residual: Residuals) -> list[Reason]:
    shares = {name: share for name, rows in residual.items() if (share := rows.relative) is not None}
    out = []
    for name, share in sorted(shares.items(), key=lambda item: -item[1]):
        if share > LARGEST_RESIDUAL and not _noise_alone(residual[name]):
            percent = f"{100.0 * share:.0f} % of the torque or force of {name} is not explained"
            means = "the model lacks an effect there, and the parameters bend to replace it"
            mark = f"{100.0 * share:.0f} % unexplained"
            out.append(Reason(percent, True, (name,), mark, f"{percent}: {means}", CHECK_TORQUE))
    return out


def _noise_alone(rows: Residual) -> bool:
    """Whether rows hold no more than their sensors' noise."""
    return rows.whitened is not None and rows.whitened <= NOISE_WHITENED


def _weak_torques(residual: Residuals) -> list[Reason]:
    """Torques that are little more than their noise: the motion is too weak, and nothing is known to be missing."""
    shares = {name: rows.relative for name, rows in residual.items() if rows.relative is not None}
    weak = {name: share for name, share in shares.items() if share > LARGEST_RESIDUAL and _noise_alone(residual[name])}
    if not weak:
        return []
    most = max(weak, key=lambda name: weak[name])
    percent = 100.0 * min(1.0, weak[most])
    text = f"weak data: {percent:.0f} % of the torque or force of {_listed(sorted(weak))} is noise"
    return [Reason(text, False, tuple(weak), "weak data", then=MOVE)]


def _loud_rows(residual: Residuals) -> list[Reason]:
    """The rows that are furthest beyond their noise."""
    worst, noise = _loudest(residual)
    if worst is None or noise <= LARGEST_WHITENED:
        return []
    full = (
        f"rows of {worst} hold {noise:.0f} times what the sensors' noise explains: the model or the samples are wrong "
        "there, by more than error bars can tell"
    )
    mark = f"{noise:.0f} × noise"
    return [Reason(f"the residual of {worst} is {mark}", True, (worst,), mark, full, CHECK_ROWS)]


def _loudest(residual: Residuals) -> tuple[str | None, float]:
    noise = {name: value for name, rows in residual.items() if (value := rows.whitened) is not None}
    worst = max(noise, key=lambda name: noise[name], default=None)
    return worst, noise[worst] if worst is not None else 0.0


def _negative(names: Sequence[str]) -> list[Reason]:
    return [
        Reason(
            f"{name} is negative, which is not physical",
            True,
            place_of(name),
            "negative",
            f"{name} is negative, which is not physical: the model lacks an effect, or the data are weak",
            DIAGNOSE,
        )
        for name in names
    ]


def _disputed(disputes: Sequence[Dispute]) -> list[Reason]:
    out = []
    for dispute in sorted(disputes, key=lambda each: -abs(each.deviations)):
        by = "" if dispute.row is None else f": rows of {dispute.row} pull it"
        off = f"{dispute.parameter} is {abs(dispute.deviations):.0f} σ off its prior"
        full = f"{off}{by}; the prior, the model or the samples are wrong there"
        out.append(Reason(off + by, True, place_of(dispute.parameter), "off its prior", full, CHECK_PRIOR))
    return out


def _cautions(facts: Facts) -> list[Reason]:
    """What makes some of the numbers, or their bars, worse than they look."""
    out = [each for each in facts.miscalibrated if not each.grave]
    out += [Reason(text, False) for text in (*facts.troubles, *facts.weaknesses)]
    out = [*_weak_torques(facts.residual), *out]
    out += [*_beyond_noise(facts.residual), *_apart(facts.comparison)]
    if vital := [name for name in facts.undetermined if name.endswith(VITAL)]:
        out.append(Reason(f"not determined: {_listed(vital)}", False, place_of(vital[0]), "not determined", then=MOVE))
    if facts.pulled:
        names = ", ".join(facts.pulled)
        out.append(
            Reason(
                f"sensor noise pulls {_listed(facts.pulled)} beyond the error bar",
                False,
                full=f"sensor noise in the columns pulls {names} by more than the error bar",
            )
        )
    out += [Reason(f"a change at {t:.1f} s came too late: values of before", False) for t in facts.undecided]
    for discrepancy in facts.discrepancies:
        if discrepancy.verdict == "passed":
            out.append(Reason(f"the residual of {discrepancy.row} was more than noise for a time", False))
    if facts.distance > LARGEST_DISTANCE:
        out.append(
            Reason(f"the estimate violates physical consistency by {facts.distance:.0f} standard deviations", False)
        )
    return out


def _moving(suspected: Suspected | None) -> list[Reason]:
    """Parameters that seem to move: the estimate is a mean over time, and its bars are no bars of the value now."""
    if suspected is None:
        return []
    names = _listed(suspected.parameters)
    text = f"{names} seems to move since {suspected.since:.1f} s, and is not followed"
    place = place_of(suspected.parameters[0])
    return [Reason(text, False, place, "may move", then=GO_ON if suspected.learning else FOLLOW)]


def _unwatched(duration: float) -> list[Reason]:
    """A long session in which a drift would show nowhere."""
    if duration < LONGEST_UNWATCHED:
        return []
    text = f"a parameter may have drifted in {duration:.0f} s: clocks of several devices wander as drifts do"
    return [Reason(text, False, then=FOLLOW)]


def _inconsistent(consistency: Consistency | None) -> list[Reason]:
    """Rows that leave more than the tracker's error bars say, where nothing else says why."""
    if consistency is None or consistency.nis is None or consistency.nis <= consistency.upper:
        return []
    text = f"normalised innovations squared are {consistency.nis:.2f}, beyond {consistency.upper:.2f}"
    return [Reason(text, False, then=DIAGNOSE)]


def _beyond_noise(residual: Residuals) -> list[Reason]:
    """Rows that hold somewhat more than noise, and torques that are not all explained."""
    out = []
    worst, noise = _loudest(residual)
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


def _apart(comparison: Comparison) -> list[Reason]:
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


def _losses(share: float) -> list[Reason]:
    lost = Reason(f"{100.0 * share:.0f} % of the samples are lost", False, then=CHECK_LOSSES)
    return [lost] if share > LARGEST_LOSS else []


def _more_than_noise(row: str, coloured: Mapping[str, float]) -> list[Reason]:
    """What a sequential test says that takes windows for independent, which coloured noise makes them less."""
    text = f"the residual of {row} is more than noise"
    if not coloured:
        return [Reason(text, True, (row,), "more than noise", then=DIAGNOSE)]
    channel = max(coloured, key=lambda name: coloured[name])
    text += f", where that of {channel} is correlated over {1e3 * coloured[channel]:.2g} ms"
    return [Reason(text, False, (row,), "coloured noise", then=CHECK_COLOUR)]


def _slow(rates: Mapping[str, float]) -> list[Reason]:
    if not rates:
        return []
    slowest = min(rates.values())
    text = f"{_listed([*rates])}: {slowest:.3g} samples/s are too few for the windows of the balance"
    return [Reason(text, False, (), "slow", then=BY_SMOOTHER)]


def _outliers(shares: Mapping[str, float]) -> list[Reason]:
    many = {channel: share for channel, share in shares.items() if share > MANY_OUTLIERS}
    if not many:
        return []
    worst = max(many, key=lambda channel: many[channel])
    others = f" and of {len(many) - 1} more channels" if len(many) > 1 else ""
    text = f"{100.0 * many[worst]:.1g} % of the samples of {worst}{others} are outliers, left out"
    return [Reason(text, False, tuple(many), "outliers", then=CHECK_OUTLIERS)]


def _grounds(facts: Facts) -> list[Reason]:
    """What trust rests on, and what it does not reach to."""
    known, of = facts.determined
    worst, noise = _loudest(facts.residual)
    shares = [share for rows in facts.residual.values() if (share := rows.relative) is not None]
    rests = ""
    if worst is not None:
        rests = ", residual " + ("no more than noise" if noise < JUST_NOISE else f"at most {noise:.2g} × noise")
    if worst is None and shares:
        rests = f", {100.0 * max(shares):.2g} % of a torque or force unexplained"
    out = [Reason(f"{known} of {of} parameters determined{rests}", False)]
    if facts.undetermined:
        out.append(Reason(f"not determined: {_listed(facts.undetermined)}", False))
    if facts.scale:
        out.append(Reason(f"the scale of all rests on the torque constants, ± {100.0 * facts.scale:.2g} %", False))
    return out


def place_of(parameter: str) -> tuple[str, ...]:
    """Where on the arm a parameter sits, from its name: `joint_i`, `link_i`, `base` or `tip`."""
    owner, _, where = parameter.rsplit(".", 1)[0].partition("@")
    if where:
        return (where,)
    owner = owner.replace("motor_", "joint_")
    return ({"spacecraft": "base", "payload": "tip"}.get(owner, owner),)


def _place(effect: str) -> str:
    """Where an effect acts."""
    return effect.partition("@")[2]


def _kind(effect: str) -> str:
    """An effect without its place."""
    return effect.partition("@")[0].replace("_", " ")


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more
