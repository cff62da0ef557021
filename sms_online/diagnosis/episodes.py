"""What a running session has noticed, and what came of it, as people and results.json have it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from sms_online.diagnosis.searcher import Named, Outcome
from sms_online.pipeline.events import Event
from sms_online.trackers.information import Information
from sms_online.verdict.evidence import Discrepancy

# A search is made when there are so many windows after an effect has begun: 1.2, 2, 3.2, 4.8, 7.2 and 12 s at the usual
# width; and of one that may have been there all the time, when so many are remembered: 4, 6, 8, 12 and 16 s.
DUE = (3.0, 5.0, 8.0, 12.0, 18.0, 30.0)
DUE_FROM_THE_START = (10.0, 15.0, 20.0, 30.0, 40.0)
# Verdicts of searches that have found what is lacking.
FOUND = ("named", "mistake")


@dataclass(frozen=True)
class Onset:
    """When an effect has begun, as grid indices: it is absent up to `last`, and present from `first`.

    last: None where it may always have been there. known: from before. patient: see `MomentumState`; of the rows that
    show it.
    """

    last: int | None
    first: int
    known: Information
    patient: bool

    @property
    def due(self) -> tuple[float, ...]:
        """Windows after it at which a search is due."""
        return DUE_FROM_THE_START if self.last is None else DUE


@dataclass(frozen=True)
class SearchAnswer:
    """The answer of a search: of samples up to `time`, s, known when samples up to `known`, s, were there."""

    time: float
    known: float
    outcome: Outcome


@dataclass
class Episode:
    """More than noise, and what came of it.

    noticed: s, samples up to then were there. row: type of the rows that leave most, "" where the smoother has noticed
    it, which has no rows of such types; began: s, None where it may have been there from the start. verdict: "noticed",
    "named", "mistake", "unexplained", "passed" where the last samples show nothing of it, "change" where a jump of
    parameters, the event, explains it, or "drift" where parameters drift, and the judged tracker follows them.
    named_at: s, when a search first named what was found in the end, when the event was decided, or when the tracker
    found the drift. adopted: s, when the model was updated with what was named; refused: why not. drifting: names of
    parameters. mistakes: of units, signs and wiring, a sentence each.
    """

    noticed: float
    row: str
    began: float | None
    verdict: str = "noticed"
    named: tuple[Named, ...] = ()
    named_at: float | None = None
    adopted: float | None = None
    refused: str | None = None
    event: Event | None = None
    drifting: tuple[str, ...] = ()
    mistakes: tuple[str, ...] = ()
    evidence: list[SearchAnswer] = field(default_factory=list)


def line(episode: Episode) -> str:
    """What there is to say of an episode."""
    what = "samples do not agree with the equations of motion"
    if episode.row:
        what = f"the residual of {episode.row} exceeds its predicted noise"
    where = f"{what} since {episode.noticed:.2f} s"
    if episode.verdict == "mistake":
        return f"{where}: {'; '.join(episode.mistakes)}"
    if episode.verdict == "named":
        effects = ", ".join(_described(named) for named in episode.named)
        taken = ""
        if episode.adopted is not None:
            taken = f"; added to the model at {episode.adopted:.2f} s"
        elif episode.refused is not None:
            taken = f"; not added to the model: {episode.refused}"
        return f"{where}: the model lacks {effects}{taken}"
    if episode.verdict == "unexplained":
        return f"{where}, which no known effect explains{_beside(_nearest(episode))}"
    if episode.verdict == "passed":
        return f"{where}, no longer there in the latest samples"
    if episode.drifting:
        return f"{where}: {', '.join(episode.drifting)} {'drifts' if len(episode.drifting) == 1 else 'drift'}"
    if episode.event is not None:
        jumps = zip(episode.event.parameters, episode.event.sizes, episode.event.units, strict=True)
        return f"{where}: {', '.join(f'{name} {size:+.4g} {unit}' for name, size, unit in jumps)}"
    return f"{where}, not named yet{_beside(_nearest(episode))}"


def _nearest(episode: Episode) -> Outcome | None:
    """The last search, where it has found what explains some of it, but leaves too much to be named."""
    last = episode.evidence[-1].outcome if episode.evidence else None
    return last if last is not None and last.keys and last.left < 1.0 else None


def _beside(nearest: Outcome | None) -> str:
    """What that is, a clause."""
    if nearest is None:
        return ""
    return f"; the nearest ({', '.join(nearest.keys)}) leave {100.0 * nearest.left:.0f} % of it"


def discrepancy(episode: Episode) -> Discrepancy:
    """An episode as the judgement of the session takes it."""
    named = tuple(each.key for each in episode.named)
    if episode.verdict in ("noticed", "unexplained"):
        named = nearest.keys if (nearest := _nearest(episode)) is not None else ()
    adopted, refused = episode.adopted is not None, episode.refused is not None
    return Discrepancy(episode.row, episode.noticed, episode.verdict, named, adopted, refused, episode.mistakes)


def _described(named: Named) -> str:
    values = ", ".join(
        f"{name} {value:.4g}" + ("" if std is None else f" ± {std:.2g}") + f" {unit}".rstrip()
        for name, (value, std, unit) in named.coefficients.items()
    )
    others = f", or {', '.join(named.ambiguous)}" if named.ambiguous else ""
    return f"{named.key}{others}" + (f" ({values})" if values else "")


def episode_document(episode: Episode) -> dict[str, Any]:
    """An episode as results.json holds it."""
    return {
        "summary": line(episode),
        "noticed": episode.noticed,
        "row": episode.row or None,
        "began": episode.began,
        "verdict": episode.verdict,
        "named": episode.named_at,
        "adopted": episode.adopted,
        "refused": episode.refused,
        "effects": [
            {
                "name": named.effect.name,
                "where": named.effect.where,
                "coefficients": {
                    name: {"estimate": value, "std": std, "unit": unit}
                    for name, (value, std, unit) in named.coefficients.items()
                },
                "ambiguous_with": list(named.ambiguous),
                "evidence": {"gain": named.gain, "limit": named.limit},
            }
            for named in episode.named
        ],
        "evidence": [
            {
                "time": evidence.time,
                "known": evidence.known,
                "verdict": evidence.outcome.verdict,
                "named": list(evidence.outcome.keys),
                "left": evidence.outcome.left,
                "candidates": evidence.outcome.scores,
            }
            for evidence in episode.evidence
        ],
    }
