"""May these numbers be trusted? One judgement of a session, of everything that is known against its estimate.

It is made here alone. What people see (the view, the status line, the pages) and `verdict` in results.json are this
judgement, so that none of them is calmer than another.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

# A joint whose unexplained torque reaches this share of the measured one lacks an effect, whatever the error bars say.
LARGEST_RESIDUAL = 0.5
# Rows that hold this many times their predicted deviation bend parameters by more than bars from the residual tell.
LARGEST_WHITENED = 3.0
# Up to here a multiple of the noise is not told: it is rounded to one, or samples are exact and there is no noise.
JUST_NOISE = 1.05
# Share of the samples that may be lost before the rest is no fair part of the motion.
LARGEST_LOSS = 0.01
# Further from the nearest real bodies than this, in standard deviations, no noise brings an estimate.
LARGEST_DISTANCE = 3.0
# A sentence is read at a glance, and fits on a line.
LONGEST_SENTENCE = 100
# Names in a sentence; the others are counted.
NAMED = 2

Level = Literal["trust", "doubt", "not yet"]


class Residual(NamedTuple):
    """What one type of rows leaves, root mean square; None where it is not known.

    relative: to the measured torque or force. whitened: over the standard deviation that the sensors' noise predicts,
    so that 1 is noise alone.
    """

    relative: float | None
    whitened: float | None


Residuals = Mapping[str, Residual]  # by type of the rows


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
class Facts:
    """What is known of a session for or against its estimate.

    determined: parameters that the data determine, and of how many. undetermined: names of the others. settling: why
    the estimate will still move by more than its error bars, empty where it will not. negative: names of estimates that
    are negative and must not be. pulled: names of those that noise in the columns pulls beyond their bars. alarm: type
    of the rows that the sequential test finds more than noise in, of a session without diagnosis. unweighed: that of
    the joint whose torque is explained so little that rows get no weights. undecided: times, s, of changes that the
    session ended too early to tell. distance: from the nearest real bodies, in standard deviations. lost: share of the
    samples. miscalibrated: what is off by more than the description's tolerances allow. troubles: whatever else, a
    short sentence each, such as of the devices of a live session.
    """

    determined: tuple[int, int]
    undetermined: tuple[str, ...] = ()
    settling: str = ""
    residual: Residuals = field(default_factory=dict)
    negative: tuple[str, ...] = ()
    pulled: tuple[str, ...] = ()
    alarm: str | None = None
    unweighed: str | None = None
    undecided: tuple[float, ...] = ()
    distance: float = 0.0
    lost: float = 0.0
    discrepancies: tuple[Discrepancy, ...] = ()
    miscalibrated: tuple[Reason, ...] = ()
    troubles: tuple[str, ...] = ()


@dataclass(frozen=True)
class Reason:
    """Why to doubt: a short sentence; grave where the error bars cannot tell how wrong the numbers are.

    places: where on the arm it sits, `joint_i`, `link_i`, `base`, `tip` or a channel; empty where nowhere. mark: a word
    or two for there. full: the same with what it means, for results.json's warnings; empty where they say it otherwise.
    """

    text: str
    grave: bool
    places: tuple[str, ...] = ()
    mark: str = ""
    full: str = ""


@dataclass(frozen=True)
class Trust:
    """May the numbers be trusted?

    level: "trust", "doubt" or "not yet". grave: of a doubt, that the numbers may be wrong by more than any error bar
    says. grounds: the strongest first; of trust, what it rests on.
    """

    level: Level
    grounds: tuple[Reason, ...]
    grave: bool = False

    @property
    def reasons(self) -> tuple[str, ...]:
        """The reasons, a short sentence each, the strongest first; of trust, what it rests on."""
        return tuple(reason.text for reason in self.grounds)

    @property
    def sentence(self) -> str:
        """The level, and whether a doubt is grave, with the strongest reason, on one line."""
        heading = "Do not trust" if self.grave else self.level.capitalize()
        return _fitted(f"{heading}: {self.grounds[0].text}")

    @property
    def others(self) -> tuple[str, ...]:
        """The reasons but for the strongest."""
        return self.reasons[1:]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons with what they mean, where nothing else in results.json says it."""
        return tuple(reason.full for reason in self.grounds if reason.full)

    @property
    def marks(self) -> dict[str, str]:
        """Where on the arm reasons to doubt sit, and a word or two for there: the strongest of each place."""
        marks: dict[str, str] = {}
        for reason in self.grounds:
            for place in reason.places:
                marks.setdefault(place, reason.mark)
        return marks

    def document(self) -> dict[str, Any]:
        """As results.json holds it."""
        return {
            "level": self.level, "grave": self.grave, "sentence": self.sentence, "reasons": list(self.reasons),
        }  # fmt: skip

    def __str__(self) -> str:
        return "\n".join([self.sentence, *(f"  {other}" for other in self.others)])


def judge(facts: Facts) -> Trust:
    """The judgement of a session.

    What has been shown to be wrong counts from when it is shown. Residuals of an estimate that is still settling show
    nothing: it was made of other, poorer rows.
    """
    settled = not facts.settling
    doubts = [*_named(facts.discrepancies)]
    if settled or facts.unweighed is not None:
        torques = _unexplained_torques(facts.residual)
        doubts += torques
        if facts.unweighed is not None and facts.unweighed not in [reason.places[0] for reason in torques]:
            doubts.append(_unweighed(facts.unweighed))
    if settled:
        doubts += _loud_rows(facts.residual)
    doubts += _unnamed(facts.discrepancies)
    if facts.alarm is not None and not any(_open(discrepancy) for discrepancy in facts.discrepancies):
        doubts.append(
            Reason(f"the residual of {facts.alarm} is more than noise", True, (facts.alarm,), "more than noise")
        )
    if settled:
        doubts += _negative(facts.negative)
    # What befell the samples comes before what that may have done to the estimate.
    losses = _losses(facts.lost)
    if doubts:
        return Trust("doubt", (*losses, *doubts, *_cautions(facts)), grave=True)
    if facts.settling:
        return Trust("not yet", (Reason(facts.settling, False), *losses, *_cautions(facts)))
    cautions = (*losses, *_cautions(facts))
    return Trust("doubt", cautions) if cautions else Trust("trust", tuple(_grounds(facts)))


def judge_diagnosis(verdict: str, effects: Sequence[str], row: str | None, after: Trust, near: bool = False) -> Trust:
    """The judgement of a diagnosed capture.

    verdict: `clean`, `named` or `unexplained`. effects: what was named, `name@where`. row: type of the rows that
    what is not explained acts on. after: of the session with what was named. near: whether effects that are named
    in an unexplained session leave little of it.
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
        told = f"the system file lacks {what}" + ("" if after.grave or after.level == "not yet" else trusted)
        found = [replace(each[0], text=told)] if len(each) == 1 else [Reason(told, after.grave), *each]
    rest = after.grounds if after.level != "trust" else ()
    return Trust("doubt", (*found, *rest), grave=found[0].grave)


def _open(discrepancy: Discrepancy) -> bool:
    """Whether an alarm is this episode's. A test that alarms after an effect was taken up tells of something else."""
    return not discrepancy.adopted and discrepancy.verdict != "change"


def _unweighed(row: str) -> Reason:
    text = f"no weights: by a first fit, most of the torque or force of {row} is not explained"
    return Reason(text, True, (row,), "not explained")


def _named(discrepancies: Iterable[Discrepancy]) -> list[Reason]:
    """Effects that the model is known to lack."""
    out = []
    for discrepancy in discrepancies:
        if discrepancy.verdict == "named" and not discrepancy.adopted:
            places = tuple(_place(effect) for effect in discrepancy.effects)
            mark = ", ".join(dict.fromkeys(_kind(effect) for effect in discrepancy.effects))
            out.append(Reason(f"the model lacks {_listed(discrepancy.effects)}", True, places, mark))
    return out


def _unnamed(discrepancies: Iterable[Discrepancy]) -> list[Reason]:
    """Rows that leave more than noise, of which nobody knows why."""
    out = []
    for discrepancy in discrepancies:
        if discrepancy.verdict in ("noticed", "unexplained"):
            why = "not named yet" if discrepancy.verdict == "noticed" else "no known effect explains it"
            text = f"more than noise in the residual of {discrepancy.row} since {discrepancy.noticed:.1f} s, {why}"
            out.append(Reason(text, True, (discrepancy.row,), "more than noise"))
    return out


def _unexplained_torques(residual: Residuals) -> list[Reason]:
    shares = {name: share for name, rows in residual.items() if (share := rows.relative) is not None}
    out = []
    for name, share in sorted(shares.items(), key=lambda item: -item[1]):
        if share > LARGEST_RESIDUAL:
            percent = f"{100.0 * share:.0f} % of the torque or force of {name} is not explained"
            means = "the model lacks an effect there, and the parameters bend to replace it"
            out.append(Reason(percent, True, (name,), f"{100.0 * share:.0f} % unexplained", f"{percent}: {means}"))
    return out


def _loud_rows(residual: Residuals) -> list[Reason]:
    """The rows that are furthest beyond their noise."""
    worst, noise = _loudest(residual)
    if worst is None or noise <= LARGEST_WHITENED:
        return []
    full = (
        f"rows of {worst} hold {noise:.0f} times what the sensors' noise explains: the model or the samples are wrong "
        "there, by more than error bars can tell"
    )
    return [Reason(f"the residual of {worst} is {noise:.0f} × noise", True, (worst,), f"{noise:.0f} × noise", full)]


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
        )
        for name in names
    ]


def _cautions(facts: Facts) -> list[Reason]:
    """What makes some of the numbers, or their bars, worse than they look."""
    out = [*facts.miscalibrated, *(Reason(trouble, False) for trouble in facts.troubles)]
    if facts.pulled:
        names = ", ".join(facts.pulled)
        out.append(
            Reason(
                f"sensor noise pulls {_listed(facts.pulled)} beyond the error bar",
                False,
                full=f"sensor noise in the columns pulls {names} by more than the error bar",
            )
        )
    out += [Reason(f"a change at {t:.1f} s came too late to be told: values of before", False) for t in facts.undecided]
    for discrepancy in facts.discrepancies:
        if discrepancy.verdict == "passed":
            out.append(Reason(f"the residual of {discrepancy.row} was more than noise for a time", False))
    if facts.distance > LARGEST_DISTANCE:
        out.append(Reason(f"no real bodies are nearer than {facts.distance:.0f} standard deviations", False))
    return out


def _losses(share: float) -> list[Reason]:
    return [Reason(f"{100.0 * share:.0f} % of the samples are lost", False)] if share > LARGEST_LOSS else []


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


def _fitted(text: str) -> str:
    """Cut at a word where it is too long to be read at a glance."""
    if len(text) <= LONGEST_SENTENCE:
        return text
    return text[: LONGEST_SENTENCE - 1].rsplit(" ", 1)[0] + "…"
