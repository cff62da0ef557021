"""Trust in a session's numbers as a record: level, reasons, next step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

# A sentence is read at a glance, and fits on a line.
LONGEST_SENTENCE = 100

Level = Literal["trust", "doubt", "not yet"]


@dataclass(frozen=True)
class Reason:
    """Why to doubt: a short sentence; grave where the numbers may be wrong by more than their error bars say.

    places: where on the arm it sits, `joint_i`, `link_i`, `base`, `tip` or a channel; empty where nowhere. mark: a word
    or two for there. full: the same with what it means, for results.json's warnings; empty where they say it otherwise.
    then: what to do next, a sentence.
    """

    text: str
    grave: bool
    places: tuple[str, ...] = ()
    mark: str = ""
    full: str = ""
    then: str = ""


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
    def next_step(self) -> str:
        """What to do about the strongest reason that something can be done about, a sentence; empty where nothing."""
        return next((reason.then for reason in self.grounds if reason.then), "")

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
        """The entry of results.json."""
        return {
            "level": self.level, "grave": self.grave, "sentence": self.sentence, "reasons": list(self.reasons),
            "next_step": self.next_step,
        }  # fmt: skip

    def __str__(self) -> str:
        then = [f"  next: {self.next_step}"] if self.next_step else []
        return "\n".join([self.sentence, *(f"  {other}" for other in self.others), *then])


def _fitted(text: str) -> str:
    """Cut at a word where it is too long to be read at a glance."""
    if len(text) <= LONGEST_SENTENCE:
        return text
    return text[: LONGEST_SENTENCE - 1].rsplit(" ", 1)[0] + "…"
